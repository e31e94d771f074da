"""Children: programs of this installation, started so that nothing is imported from the folder one happens to be in."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = str(Path(__file__).resolve().parents[2])  # where hw, pipeline and disco_twin lie


def module_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module as a program, in `child_environment`; -P keeps the current folder off the path."""
    return [sys.executable, "-P", "-m", module, *arguments]


def code_command(code: str) -> list[str]:
    """The command that runs a text of Python, in `child_environment`."""
    return [sys.executable, "-P", "-c", code]


def child_environment() -> dict[str, str]:
    """This process's environment; its children import from where it does itself, and their messages are UTF-8.

    The first place of `sys.path` is the script's or the current folder: what lies there is nobody's but the user's.
    """
    own = [path for path in sys.path[1:] if os.path.isabs(path)]
    paths = own if ROOT in own else [ROOT, *own]
    return os.environ | {
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONSAFEPATH": "1",
        "PYTHONIOENCODING": "utf-8:backslashreplace",
    }
