"""Errors that a user is meant to read: one line, no traceback."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date, time
from pathlib import Path
from typing import Any, Self

MOST_SHOWN = 160  # characters of a value


class DiscoError(Exception):
    """A failure with a known cause. The command line prints it as one line and exits with status 2."""


class InputError(DiscoError):
    """Bad input: names file, key, value, the allowed range and the remedy, as far as each is known."""

    def __init__(
        self, problem: str, *, file: str | Path | None = None, key: str | None = None, value: object = None,
        allowed: str | None = None, remedy: str | None = None,
    ) -> None:  # fmt: skip
        self.problem, self.file, self.key, self.value = problem, file, key, value
        self.allowed, self.remedy = allowed, remedy
        where = "" if file is None else f"{file}: "
        what = "" if key is None else (f"{key}: " if value is None else f"{key} = {_shown(value)}: ")
        tail = ("" if allowed is None else f" (allowed: {allowed})") + ("" if remedy is None else f". Remedy: {remedy}")
        super().__init__(f"{where}{what}{problem}{tail}")

    def amended(self, **changes: Any) -> InputError:
        """The same error, with another problem, file, key, value, allowed range or remedy."""
        same = {name: getattr(self, name) for name in ("problem", "file", "key", "value", "allowed", "remedy")}
        return InputError(**(same | changes))

    def within(self, file: str | Path) -> InputError:
        """The same error, known to come from `file`, unless it names a file already."""
        return self if self.file is not None else self.amended(file=file)


class Refused(DiscoError):
    """The rig was asked for something unsafe or impossible, and did not do it."""


class DeviceError(DiscoError):
    """Something is wrong with a device: names its port, the device as the rig calls it, the problem and the remedy.

    key, file: where the port is set, as far as known
    """

    def __init__(
        self, port: str, device: str, problem: str, remedy: str, *, key: str | None = None,
        file: str | Path | None = None,
    ) -> None:  # fmt: skip
        self.port, self.device, self.problem, self.remedy = port, device, problem, remedy
        self.key, self.file = key, file
        where = port if key is None else f"{'' if file is None else f'{file}: '}{key} = {_shown(port)}"
        self.without_remedy = f"{where}: {device} {problem}"
        super().__init__(f"{self.without_remedy}. Remedy: {remedy}")

    def set_by(self, key: str, port: str, file: str | Path | None) -> Self:
        """The same error, of a device whose port is set by `key` of a rig file."""
        return type(self)(port, self.device, self.problem, self.remedy, key=key, file=file)


class NoAnswer(DeviceError):
    """The device did not answer in time. What it was asked to do may have happened nevertheless."""


class Garbled(DeviceError):
    """The device's answer makes no sense. What it was asked to do may have happened nevertheless."""


class Unplugged(DeviceError):
    """The port cannot be opened, read or written. `known`: it was reported before."""

    known = False


class SwitchedOff(Unplugged):
    """The supervisor has made everything dark, or is about to, and closed its ports."""


class WrongDevice(DeviceError):
    """Another device than the expected one is at this port."""


class DeviceRefused(DeviceError):
    """The device understood and did not do it."""


class DeviceFault(DeviceError):
    """The device reports a fault of its own: interlock, stall, over-temperature, a lost reference."""


@contextmanager
def naming(file: str | Path) -> Iterator[None]:
    """Errors about a key that leave this block name the file that the key stands in."""
    try:
        yield
    except InputError as error:
        raise error.within(file) from error.__cause__


def refused_by_the_disk(error: OSError, folder: Path) -> DiscoError | None:
    """A full or write-protected disk, or a path that cannot be, as an error for the user; None for any other reason.

    NumPy reports a full disk without an error number ("16 requested and 0 written", "Not enough free space to write").
    """
    if error.errno == errno.EFBIG:
        remedy = "raise the limit (ulimit -f) or choose another disk, repeat the same command"
        return DiscoError(f"{error.filename or folder}: no file may be that large here. Remedy: {remedy}")
    said = str(error)
    full = error.errno in (errno.ENOSPC, errno.EDQUOT) or "requested and" in said or "Not enough free space" in said
    if not full and error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.ENAMETOOLONG):
        return None
    why = "the disk is full" if full else (error.strerror or str(error)).lower()
    remedy = "make room" if full else "choose another --out"
    return DiscoError(f"{error.filename or folder}: {why}. Remedy: {remedy}, repeat the same command")


def _shown(value: object) -> str:
    """A value as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return _cut(f"[{', '.join(map(_shown, value[:MOST_SHOWN]))}]")
    if isinstance(value, date | time):
        return value.isoformat()
    if isinstance(value, int) and value.bit_length() > MOST_SHOWN:
        return _cut(hex(value))  # Python refuses to write thousands of digits
    return _cut(repr(value))


def _cut(text: str) -> str:
    """Its beginning: a message is to be read."""
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."
