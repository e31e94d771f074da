"""Do the spots lie where projector, scan and cameras, as stated, put them? If not, which way round are the mirrors?

A spot is where its image is brightest; what that says of a spot that the camera does not see is nothing, so such
images are not counted. A rig that stands as it is set up by hand misses by a few beam diameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

from hw.base.arrays import F64
from hw.interface import Aim
from hw.record import RawImage, Sensor, to_radiance
from pipeline.capture.silhouettes import nominal_view
from pipeline.geometry.camera import turn
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.stream.stream import CorruptImage, StreamReader

MOST_IMAGES = 60  # spread over all
SURE = 10.0  # standard deviations of the brightest pixel
BEAMS, SHARE = 2.0, 0.06  # a spot may be off by so many beam diameters, or by this share of the object's size
LEAST = 8  # images, to say anything
RIGHT, WRONG = 0.6, 0.5  # share of spots in their places: at least where all is right, at most where something is wrong
OBLIQUE = 0.2  # cosine to the camera below which its image tells nothing
NEARER = 0.5  # times the distance: a reading under which spots lie so much closer to their places is the right one
AXES = {  # what people get wrong -> (u, v) of the table as the real ones, about the middle step
    "u counts the other way": ((-1, 0), (0, 1)),
    "v counts the other way": ((1, 0), (0, -1)),
    "u and v count the other way": ((-1, 0), (0, -1)),
    "u and v are exchanged": ((0, 1), (1, 0)),
    "full_angle_deg is half of what it should be": ((2, 0), (0, 2)),
    "full_angle_deg is twice what it should be": ((0.5, 0), (0, 0.5)),
}


@dataclass(frozen=True)
class Sighting:
    """The brightest place of an image. pixel: (2,) x, y."""

    view: int
    aim: Aim
    pixel: F64


@dataclass(frozen=True)
class SpotFit:
    """Share of the spots in their places, as stated and for each other reading of u and v; None: too few to tell.

    nearer: whether under the first of the others they lie much closer to their places
    """

    stated: float | None
    others: tuple[tuple[str, float], ...] = ()
    nearer: bool = False

    @property
    def fits(self) -> bool:
        """Whether nothing speaks against the stated places."""
        return self.stated is None or (self.stated > WRONG and not self.nearer)

    @property
    def decisive(self) -> bool:
        """Whether another reading fits beyond doubt."""
        return not self.fits and bool(self.others) and self.others[0][1] >= RIGHT

    @property
    def problem(self) -> str:
        """What is wrong, without the remedy."""
        assert self.stated is not None
        text = f"only {100 * self.stated:.0f} % of the spots lie where projector, scan and cameras as stated put them"
        if self.decisive:
            text += f"; likeliest cause: {self.others[0][0]} ({100 * self.others[0][1]:.0f} % then"
            text += ", and at less than half the distance)" if self.nearer else ")"
        return text + "; others: " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.others)

    @property
    def remedy(self) -> str:
        """What to do about it."""
        if self.decisive:
            return "correct u and v in images.csv, or the rig's mirror axes and rig.projector.full_angle_deg"
        return "check rig.projector (place, aim, up, full_angle_deg) and u, v"

    def warnings(self) -> list[str]:
        """One line where the spots do not lie in their places; else none."""
        return [] if self.fits else [f"{self.problem}. Remedy: {self.remedy}"]


def chosen_spots(plan: Plan) -> list[ImageAddress]:
    """Images that are looked at: of the middle laser, all or some spread over views and spots."""
    own = [a for a in plan.addresses() if a.kind == "spot" and a.laser == plan.lasers // 2]
    return [own[k] for k in np.unique(np.linspace(0, len(own) - 1, min(len(own), MOST_IMAGES)).round().astype(int))]


def sighting(view: int, aim: Aim, raw: RawImage, sensor: Sensor, laser: int) -> Sighting | None:
    """Where an image is brightest; None where it shows nothing beyond doubt. Single bright pixels do not count."""
    image = to_radiance(raw, sensor, laser)
    smooth = ndimage.median_filter(image.radiance, 3)
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    if smooth[row, column] < SURE * np.sqrt(float(image.variance[row, column])):
        return None
    rows, columns = np.nonzero(smooth >= 0.7 * smooth[row, column])  # a saturated spot is flat
    near = np.hypot(rows - row, columns - column) < 0.1 * max(smooth.shape)
    return Sighting(view, aim, np.array([columns[near].mean() + 0.5, rows[near].mean() + 0.5]))


def sightings_of(stream: StreamReader, sensor: Sensor) -> Iterable[Sighting]:
    """Those of a stream, finished or not."""
    for address in chosen_spots(stream.plan):
        if stream.plan.index(address) < len(stream):
            try:
                raw = stream.read(address)
            except CorruptImage:
                continue
            found = sighting(address.view, stream.plan.spots[address.spot], raw, sensor, address.laser)
            if found is not None:
                yield found


def examine_spots(found: Sequence[Sighting], rig: RigConfig, mesh: trimesh.Trimesh, slack: float = 0.0) -> SpotFit:
    """Compare sightings with where the nominal rig puts the spots. slack: as of `examine_silhouettes`."""
    surface = RayMesh.of(mesh)
    stated = _in_place(found, rig, surface, ((1, 0), (0, 1)), slack)
    if stated is None:
        return SpotFit(None)
    others = [(name, _in_place(found, rig, surface, axes, slack)) for name, axes in AXES.items()]
    ordered = sorted(((name, other) for name, other in others if other is not None), key=lambda o: (-o[1][0], o[1][1]))
    nearer = [name for name, other in ordered if other[0] >= RIGHT and other[1] < NEARER * stated[1]]
    if nearer and np.inf > stated[1] > 0.5 * rig.projector.beam_diameter_mm:
        ordered.sort(key=lambda other: other[0] != nearer[0])  # stable: that one first
        return SpotFit(stated[0], tuple((name, other[0]) for name, other in ordered), nearer=True)
    return SpotFit(stated[0], () if stated[0] > WRONG else tuple((name, other[0]) for name, other in ordered))


def _in_place(
    found: Sequence[Sighting], rig: RigConfig, surface: RayMesh, axes: tuple[tuple[float, float], tuple[float, float]],
    slack: float,
) -> tuple[float, float] | None:  # fmt: skip
    """Share of the sightings near their spot, of those whose spot the camera sees or which miss the scan, and their
    median distance from it in mm, infinite where all miss; None if few.

    axes: (2, 2) sign, order and scale of (u, v), about the middle of the steps.
    """
    angles, middle = len(rig.turntable_angles_deg), (rig.projector.steps - 1) / 2
    near = counted = 0
    distances: list[float] = []
    for view in sorted({s.view for s in found}):
        own = [s for s in found if s.view == view]
        turned = turn(float(np.deg2rad(rig.turntable_angles_deg[view % angles])))
        projector = TwoMirrorProjector.from_config(rig.projector).seen_from(turned)
        steps = (np.array([(s.aim.u, s.aim.v) for s in own], float) - middle) @ np.array(axes, float).T + middle
        hit = surface.first_hit(*projector.rays(steps))
        met = np.flatnonzero(hit.triangle >= 0)
        camera = nominal_view(rig, view)
        points = surface.points(hit.triangle[met], hit.barycentric[met])
        towards = camera.position - points
        distance = np.linalg.norm(towards, axis=1)
        towards /= distance[:, None]
        cosine = (surface.normals[hit.triangle[met]] * towards).sum(axis=1)
        visible = (cosine > OBLIQUE) & ~surface.blocked(hit.triangle[met], points, towards)
        counted += len(own) - len(met) + int(np.count_nonzero(visible))
        if visible.any():
            scale = distance[visible, None] / float(camera.focal.mean())  # mm in a pixel
            pixels = np.array([own[k].pixel for k in met[visible]])
            off = (camera.project(points[visible])[0] - pixels) * scale
            off -= np.clip(np.median(off, axis=0), -slack * surface.size, slack * surface.size)
            allowed = max(BEAMS * rig.projector.beam_diameter_mm, SHARE * surface.size)
            near += int(np.count_nonzero(np.linalg.norm(off, axis=1) < allowed))
            distances += np.linalg.norm(off, axis=1).tolist()
    return (near / counted, float(np.median(distances or [np.inf]))) if counted >= LEAST else None
