"""The entry point: Ctrl-C while the modules are still being read ends the program in one line, too."""

from __future__ import annotations

import sys


def main() -> None:
    """`disco-twin`."""
    try:
        from disco_twin.cli import main as command
        from hw.signals import end_when_told

        end_when_told()
        command()
    except KeyboardInterrupt:
        sys.stderr.write("disco-twin: stopped; the same command continues\n")
        sys.exit(130)
