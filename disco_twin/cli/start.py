"""The entry point: what is to be right before anything else is read, and what ends the program meanwhile."""

from __future__ import annotations

import io
import os
import signal
import sys


def main() -> None:
    """`disco-twin`."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that lacks a character shows its number instead
            stream.reconfigure(errors="backslashreplace")
    try:
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):  # as Ctrl-C; `hw.safety.signals` does more
            if signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, signal.default_int_handler)
        _require_current_folder()
        from disco_twin.cli.app import main as command
        from hw.safety.signals import exit_on_first_signal

        exit_on_first_signal()
        command()
    except KeyboardInterrupt:
        sys.stderr.write("disco-twin: stopped; the same command continues\n")
        sys.exit(130)


def _require_current_folder() -> None:
    """Relative names, and much of Python, need one."""
    try:
        os.getcwd()
    except OSError:
        sys.stderr.write("disco-twin: the current folder is gone. Remedy: change into one that exists\n")
        sys.exit(2)
