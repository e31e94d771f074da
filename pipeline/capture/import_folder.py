"""Captures that were made without our software: a folder of 16-bit images, a table and a description -> our stream.

FOLDER/capture.toml   `CaptureDescription`: the nominal rig as in a scene, what is known of the sensor, the scan's file
FOLDER/images.csv     one line a frame, with the columns COLUMNS; frames that differ in exposure_s alone are a bracket
FOLDER/...            the frames: 16-bit grey PNG or TIFF, raw digital numbers, black level included

Everything is checked against everything else before anything is stored (`import_checks`). docs/lab.md has an example.

OUT/import.json holds the key of all that was imported and what was written beside the stream. The same import resumes;
one of other content takes its place, if what the earlier one wrote is still as it left it; nothing else is overwritten.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from hw.base.config import Strict, load_toml, read_json
from hw.base.errors import DiscoError, InputError
from hw.base.files import alone_in, write_atomically, write_json
from pipeline.capture.import_checks import pictures_of, require_consistent
from pipeline.capture.import_description import CaptureDescription
from pipeline.capture.import_frames import frame_digest, read_frame
from pipeline.capture.import_table import COLUMNS, Frame, Key, key_of, meta_of, plan_of, read_table
from pipeline.geometry.mesh_file import read_scan
from pipeline.plan.plan import Plan
from pipeline.records import write_capture_records
from pipeline.stream.files import IMAGES, JOURNAL, PLAN
from pipeline.stream.stream import StreamWriter

__all__ = ["COLUMNS", "CaptureDescription", "import_capture", "read_frame"]

RECORD = "import.json"
STREAM = (IMAGES, JOURNAL)  # grow while an import goes on; each of their images has a checksum of its own
WRITTEN = ("scan.ply", "rig.json", "sensor.json", PLAN)
ANOTHER = "choose another --out"

log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]


class ImportRecord(Strict):
    """OUT/import.json. files: digests of `WRITTEN`, as far as they are there."""

    format_version: Literal[1]
    key: str
    files: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True)
class Foreign:
    """A folder as it was read: everything but the frames' pixels."""

    table: Path
    described: CaptureDescription
    scan: bytes
    brackets: dict[Key, list[Frame]]
    plan: Plan


def import_capture(folder: Path, out: Path, progress: Progress | None = None) -> Plan:
    """Write the stream and what the pipeline is told with it into `out`; the plan that the images make up.

    progress: images done, of twice their number: each is checked, then stored. What speaks against the stated poses
    without being a contradiction is logged as a warning.
    Raises: InputError, with the line of the table where there is one, or for a folder that holds anything else.
    """
    report = progress or (lambda done, total: None)
    foreign = read_foreign(folder)
    key = _content_key(foreign)
    record = _require_claimable(out)
    count = len(foreign.plan)
    if record is None or record.key != key:
        warnings = require_consistent(
            folder / "capture.toml", foreign.table, foreign.described, read_scan(foreign.described.scan),
            foreign.brackets, foreign.plan, lambda done: report(done, 2 * count),
        )  # fmt: skip
        for line in warnings:
            log.warning("%s", line)
    out.mkdir(parents=True, exist_ok=True)
    problem = f"{out}: another process works in this folder"
    with alone_in(out, DiscoError(f"{problem}. Remedy: wait for it, or {ANOTHER}")):
        _claim(out, key)
        _store(foreign, out, key, report)
    return foreign.plan


def read_foreign(folder: Path) -> Foreign:
    """Description, scan and table of a folder. Raises: InputError."""
    what = "a capture.toml (docs/lab.md, section 6, shows one)"
    described = load_toml(folder / "capture.toml", CaptureDescription, what)
    scan = bytes(read_scan(described.scan).export(file_type="ply"))
    table = folder / "images.csv"
    brackets = read_table(table, described)
    return Foreign(table, described, scan, brackets, plan_of(table, described.rig, brackets))


def _content_key(foreign: Foreign) -> str:
    """Digest of all that is imported: description, scan, table, the frames' bytes; not of where they lie."""
    digest = hashlib.blake2b(foreign.described.model_dump_json(exclude={"scan"}).encode())
    digest.update(foreign.scan + foreign.plan.to_json().encode())
    for key, frames in sorted(foreign.brackets.items()):
        for frame in frames:
            content = frame_digest(frame.file, f"line {frame.line} of {foreign.table}")
            digest.update(f"{key} {frame.exponent} {frame.power_w!r} {frame.time_s!r} {content}\n".encode())
    return digest.hexdigest()


def _require_claimable(out: Path) -> ImportRecord | None:
    """What an earlier import left; None for a folder that is empty or not there. Raises: InputError for any other."""
    if out.exists() and not out.is_dir():
        raise InputError("is not a folder", file=out, remedy=ANOTHER)
    there = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not os.access(there, os.W_OK | os.X_OK):  # before hours of reading
        raise InputError("cannot be written to", file=there, remedy=ANOTHER)
    if not (out / RECORD).is_file():
        held = [path for path in out.iterdir() if path.name != f"{RECORD}.part"] if out.is_dir() else []
        if held:
            raise InputError("the folder is not empty and holds no import", file=out, remedy=ANOTHER)
        return None
    record = read_json(out / RECORD, ImportRecord, f"delete the folder, or {ANOTHER}")
    for name, digest in record.files.items():
        if (out / name).is_file() and _digest(out / name) != digest:
            problem = "was changed since it was imported"
            raise InputError(problem, file=out / name, remedy=f"{ANOTHER}, or delete this file")
    return record


def _claim(out: Path, key: str) -> None:
    """Make the folder this key's; what an import of another key wrote is removed. Raises: as `_require_claimable`."""
    record = _require_claimable(out)
    if record is not None and record.key == key:
        return
    if record is not None:
        log.warning("%s held an import of other content, which is replaced", out)
        for name in (*STREAM, *WRITTEN):
            (out / name).unlink(missing_ok=True)
    write_json(out / RECORD, ImportRecord(format_version=1, key=key).model_dump())


def _store(foreign: Foreign, out: Path, key: str, report: Progress) -> None:
    plan, described = foreign.plan, foreign.described
    write_capture_records(out, foreign.scan, described.rig, described.known)
    write_atomically(out / PLAN, plan.to_json().encode())
    files = {name: _digest(out / name) for name in WRITTEN}
    write_json(out / RECORD, ImportRecord(format_version=1, key=key, files=files).model_dump())
    count = len(plan)
    with StreamWriter(out, plan) as stream:
        for index in range(len(stream), count):
            address = plan.address(index)
            frames = foreign.brackets[key_of(plan, address)]
            pictures = pictures_of(foreign.table, described, frames, plan.camera_of(address.view))
            stream.append(address, described.bracket.merge(pictures), meta_of(plan, address, frames))
            report(count + index + 1, 2 * count)


def _digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes()).hexdigest()
