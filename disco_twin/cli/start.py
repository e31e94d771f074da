"""The entry point: Ctrl-C while the modules are still being read ends the program in one line, too."""

from __future__ import annotations

import sys


def main() -> None:
    """`disco-twin`."""
    try:
        from disco_twin.cli.app import main as command
        from hw.safety.signals import exit_on_first_signal

        exit_on_first_signal()
        command()
    except KeyboardInterrupt:
        sys.stderr.write("disco-twin: stopped; the same command continues\n")
        sys.exit(130)
