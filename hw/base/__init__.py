"""What every room stands on: errors in one line, configuration from TOML, files, clocks, resources."""
