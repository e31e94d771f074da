"""The file layer: files are replaced as a whole, carry `format_version`, and are worked on by one process at a time."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from hw.base.errors import DiscoError, InputError

Arrays = dict[str, NDArray[Any]]


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A new file that takes the place of `path` when the block ends: a reader, or a run after a crash, sees the old
    content or the new. It keeps the mode of the old one, and what links to it.

    Raises: OSError where the disk refuses; it names `path`, and nothing is left of what was not written in full.
    """
    target = Path(os.path.realpath(path))
    fresh = target.with_name(target.name + ".part")
    try:
        fresh.unlink(missing_ok=True)  # a read-only one of a killed run could not be opened
        with fresh.open("wb") as file:
            with suppress(FileNotFoundError):
                shutil.copymode(target, fresh)
            yield file
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(target)
    except BaseException as error:
        with suppress(OSError):
            fresh.unlink()
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, str(fresh)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_atomically(path: Path, content: bytes) -> None:
    """Replace a file as a whole. Raises: OSError as `replacing`."""
    with replacing(path) as file:
        file.write(content)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Replace a JSON file as a whole. Raises: ValueError for a NaN, which no other reader would accept."""
    write_atomically(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def save_arrays(path: Path, version: int, arrays: Mapping[str, NDArray[Any]], **head: Any) -> None:
    """Replace an .npz as a whole: arrays, and a head of whatever JSON holds, with `format_version`. No pickle.

    Raises: OSError as `replacing`.
    """
    with replacing(path) as file:
        everything = {"head": np.array(json.dumps({"format_version": version} | head)), **arrays}
        np.savez(file, **everything)  # type: ignore[arg-type]  # the stubs fear an array named allow_pickle


def load_arrays(
    path: Path, version: int, remedy: str, names: Collection[str] | None = None
) -> tuple[dict[str, Any], Arrays]:
    """Head and arrays (all of them, or those of `names`) that `save_arrays` wrote.

    Raises: InputError for a file that is missing, damaged, or of another format version.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            head = json.loads(str(data["head"])) if "head" in data else {"format_version": _older(data)}
            require_version(path, head.get("format_version"), version, remedy)
            return head, {name: data[name] for name in (data.files if names is None else names) if name != "head"}
    except FileNotFoundError as error:
        raise InputError("is missing", file=path, remedy=remedy) from error
    except (OSError, BadZipFile, zlib.error, ValueError, EOFError, TypeError, AttributeError, RuntimeError) as error:
        raise InputError("is damaged, or another kind of file", file=path, remedy=remedy) from error
    except KeyError as error:
        raise InputError(f"is damaged (it lacks {error})", file=path, remedy=remedy) from error


def _older(data: Mapping[str, NDArray[Any]]) -> int | None:
    """The version of a file from before heads."""
    return int(data["format_version"]) if "format_version" in data else None


def require_version(path: Path, found: Any, version: int, remedy: str) -> None:
    """Refuse a file of another format version. Raises: InputError."""
    if found != version:
        key, allowed = "format_version", str(version)
        raise InputError("another format", file=path, key=key, value=found, allowed=allowed, remedy=remedy)


def take_lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed; False where another process holds it. POSIX only."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def alone_in(folder: Path, refusal: DiscoError) -> Iterator[None]:
    """A block in which no other process works in a folder; the lock ends with its program, however that ends.

    Raises: `refusal` where another process is in such a block.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        if not take_lock(handle):
            raise refusal
        yield
    finally:
        os.close(handle)


def require_folder(folder: Path, option: str) -> None:
    """Make the folder that an option names. Raises: InputError where it cannot be made or written to."""
    remedy = f"choose another {option}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError("a file is in its place", file=folder, key=option, remedy=remedy) from error
    except OSError as error:
        problem = f"cannot be written to ({(error.strerror or str(error)).lower()})"
        raise InputError(problem, file=folder, key=option, remedy=remedy) from error
