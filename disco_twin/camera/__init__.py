"""The twin's camera: lens, sensor and calibration targets."""
