"""Errors that a user is meant to read: one line, no traceback."""

from __future__ import annotations

from pathlib import Path


class DiscoError(Exception):
    """A failure with a known cause. The command line prints it as one line and exits with status 2."""


class InputError(DiscoError):
    """Bad input: names file, key, value, the allowed range and the remedy, as far as each is known."""

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        key: str | None = None,
        value: object = None,
        allowed: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem, self.file, self.key, self.value = problem, file, key, value
        self.allowed, self.remedy = allowed, remedy
        where = "" if file is None else f"{file}: "
        what = "" if key is None else (f"{key}: " if value is None else f"{key} = {value!r}: ")
        tail = ("" if allowed is None else f" (allowed: {allowed})") + ("" if remedy is None else f". Remedy: {remedy}")
        super().__init__(f"{where}{what}{problem}{tail}")
