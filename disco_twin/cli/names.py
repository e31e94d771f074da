"""Names of files and folders on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hw.base.errors import InputError


def given(what: str) -> Callable[[str | Path], Path]:
    """A parser of an option or argument that names a path.

    An empty name (a shell's variable that is not set) would mean the current folder. Raises: InputError for one.
    """

    def parse(text: str | Path) -> Path:
        if not str(text).strip():
            raise InputError("is empty", key=what, remedy="name a file or folder; `.` is the current one")
        return Path(text)

    return parse
