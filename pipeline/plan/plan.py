"""Which images a capture consists of, in what order: the plan.

The order is the thesis's (fig. 4.1): for every camera and turntable angle a silhouette image, then every spot of that
angle in every laser. Cameras are outermost: view = camera * number of angles + angle. An image's index in the plan is
its place in the stream.
"""

from __future__ import annotations

import hashlib
import json
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from hw.base.config import Strict, in_words, read_json
from hw.base.errors import InputError
from hw.interface import Aim
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.plan.spots import choose_spots
from pipeline.plan.visibility import require_rig_in_sight

if TYPE_CHECKING:
    import trimesh

FORMAT_VERSION = 1


@dataclass(frozen=True)
class ImageAddress:
    """One image of a plan. `spot` is the index into the plan's spots; silhouettes have spot = laser = -1."""

    view: int
    kind: Literal["silhouette", "spot"]
    spot: int = -1
    laser: int = -1

    def __str__(self) -> str:
        return f"view {self.view}, " + (
            "silhouette" if self.kind == "silhouette" else f"spot {self.spot}, laser {self.laser}"
        )


class _PlanFile(Strict):
    """plan.json."""

    format_version: Literal[1]
    cameras: Annotated[tuple[str, ...], Field(min_length=1)]
    angles_rad: Annotated[tuple[float, ...], Field(min_length=1)]
    lasers: Annotated[int, Field(ge=1)]
    spots: tuple[tuple[int, int, int], ...]  # (angle, u, v)


@dataclass(frozen=True)
class Plan:
    """cameras: names; angles_rad: turntable angles; spots: grouped by angle, in the order they are lit.

    The plan of a camera's targets counts placements instead of angles, and `angles_rad` holds their numbers 0, 1, 2 ...
    (`pipeline.plan.targets`): nothing turns between them, and the file keeps one form.
    """

    cameras: tuple[str, ...]
    angles_rad: tuple[float, ...]
    spots: tuple[Aim, ...]
    lasers: int

    def __post_init__(self) -> None:
        angles = [aim.angle for aim in self.spots]
        if angles != sorted(angles) or (angles and not 0 <= angles[0] <= angles[-1] < len(self.angles_rad)):
            raise ValueError("spots must be grouped by angle, and every angle must be one of the plan's")

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.cameras) * len(self.angles_rad)

    def camera_of(self, view: int) -> int:
        """Index of the camera of a view."""
        return view // len(self.angles_rad)

    def angle_of(self, view: int) -> int:
        """Index of the turntable angle of a view."""
        return view % len(self.angles_rad)

    def spots_at(self, angle: int) -> range:
        """Indices of the spots of a turntable angle."""
        return range(self._first_spot[angle], self._first_spot[angle + 1])

    @cached_property
    def _first_spot(self) -> tuple[int, ...]:
        counts = np.bincount([aim.angle for aim in self.spots], minlength=len(self.angles_rad))
        return (0, *(int(n) for n in np.cumsum(counts)))

    @cached_property
    def _first_image(self) -> tuple[int, ...]:
        """Index of every view's silhouette image, and the total at the end."""
        sizes = [1 + self.lasers * len(self.spots_at(self.angle_of(view))) for view in range(self.views)]
        return (0, *accumulate(sizes))

    def __len__(self) -> int:
        return self._first_image[-1]

    def address(self, index: int) -> ImageAddress:
        """The image at a place of the stream."""
        if not 0 <= index < len(self):
            raise IndexError(f"image {index} of a plan of {len(self)}")
        view = bisect_right(self._first_image, index) - 1
        rest = index - self._first_image[view] - 1
        if rest < 0:
            return ImageAddress(view, "silhouette")
        spot, laser = divmod(rest, self.lasers)
        return ImageAddress(view, "spot", self.spots_at(self.angle_of(view))[spot], laser)

    def index(self, address: ImageAddress) -> int:
        """The place of an image in the stream: the inverse of `address`."""
        if not 0 <= address.view < self.views:
            raise IndexError(f"{address}: the plan has {self.views} views")
        first = self._first_image[address.view]
        if address.kind == "silhouette":
            return first
        spots = self.spots_at(self.angle_of(address.view))
        if address.spot not in spots or not 0 <= address.laser < self.lasers:
            raise IndexError(f"{address}: this view has spots {spots.start} to {spots.stop - 1}, {self.lasers} lasers")
        return first + 1 + (address.spot - spots.start) * self.lasers + address.laser

    def addresses(self) -> Iterator[ImageAddress]:
        """All images in the order of the capture."""
        return (self.address(index) for index in range(len(self)))

    def to_json(self) -> str:
        """Canonical text: equal plans give equal bytes."""
        file = {
            "format_version": FORMAT_VERSION,
            "cameras": self.cameras,
            "angles_rad": self.angles_rad,
            "lasers": self.lasers,
            "spots": [(aim.angle, aim.u, aim.v) for aim in self.spots],
        }
        return json.dumps(file, separators=(",", ":")) + "\n"

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 of the canonical text, 32 bytes: what a stream carries to know its plan."""
        return hashlib.sha256(self.to_json().encode()).digest()


def load_plan(path: Path) -> Plan:
    """Read plan.json. Raises: InputError where it is missing, damaged, or of another format version."""
    remedy = "repeat the capture command"
    file = read_json(path, _PlanFile, remedy)
    try:
        return Plan(file.cameras, file.angles_rad, tuple(Aim(*spot) for spot in file.spots), file.lasers)
    except ValueError as error:
        raise InputError(f"is damaged ({in_words(error)})", file=path, remedy=remedy) from error


def make_plan(rig: RigConfig, mesh: trimesh.Trimesh) -> Plan:
    """The plan of a nominal rig for the scanned mesh (object frame, mm): exactly `rig.spots` spots.

    Raises: InputError where a camera does not see the object, or the laser does not reach it in enough places.
    """
    require_rig_in_sight(rig, mesh)
    angles = tuple(float(a) for a in np.deg2rad(rig.turntable_angles_deg))
    return Plan(tuple(c.name for c in rig.cameras), angles, choose_spots(rig, mesh), len(rig.lasers))
