"""The lasers' own readings, taken in the dark before every view, as a table beside the stream: `lasers.csv`.

A photodiode behind the gate sees what reaches the object; the laser's own reading shows whether a change of that came
from the laser. The table explains images and is no part of them: a capture is whole without it.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hw.interface import LaserReading

log = logging.getLogger(__name__)

LASERS = "lasers.csv"
COLUMNS = "view,time_s,laser,set_w,own_w,dark_w"
DRIFT_SHARE = 0.03  # of a laser's first own reading: beyond, the view is marked


@dataclass(frozen=True)
class LaserRow:
    """One laser before one view; watts and the rig's clock in seconds."""

    view: int
    time_s: float
    laser: int
    set_w: float
    own_w: float
    dark_w: float


def append_lasers(folder: Path, view: int, time_s: float, readings: Sequence[LaserReading]) -> None:
    """Add a view's readings, on disk when this returns. A line that a crash cut off is left to stand alone."""
    if not readings:
        return
    path = folder / LASERS
    rows = [f"{view},{time_s!r},{i},{r.set_w!r},{r.own_w!r},{r.dark_w!r}\n" for i, r in enumerate(readings)]
    with path.open("a+b") as file:
        size = file.seek(0, os.SEEK_END)
        if size:
            file.seek(size - 1)
        begin = f"{COLUMNS}\n" if not size else "" if file.read(1) == b"\n" else "\n"
        file.write((begin + "".join(rows)).encode())
        file.flush()
        os.fsync(file.fileno())


def read_lasers(folder: Path) -> list[LaserRow]:
    """All rows, in the order in which they were taken; none where no laser has a reading of its own."""
    path = folder / LASERS
    rows: list[LaserRow] = []
    if not path.is_file():
        return rows
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines()):
        if line == COLUMNS or not line:
            continue
        try:
            view, time_s, laser, *watts = line.split(",")
            set_w, own_w, dark_w = map(float, watts)
            rows.append(LaserRow(int(view), float(time_s), int(laser), set_w, own_w, dark_w))
        except ValueError:
            log.warning("%s: line %d is damaged and left out", path, number + 1)
    return rows


def drifts(rows: Sequence[LaserRow]) -> dict[int, float]:
    """View -> the largest share by which any laser's own reading was off its first one; a view's last rows count.

    Infinite where a reading is no number, or the first one is not above zero.
    """
    first: dict[int, float] = {}
    last: dict[tuple[int, int], float] = {}
    for row in rows:
        first.setdefault(row.laser, row.own_w)
        share = abs(row.own_w / first[row.laser] - 1.0) if first[row.laser] > 0.0 else math.inf
        last[row.view, row.laser] = share if math.isfinite(share) else math.inf
    found: dict[int, float] = {}
    for (view, _), share in last.items():
        found[view] = max(found.get(view, 0.0), share)
    return found
