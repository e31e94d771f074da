"""Do the silhouettes show the scan where the stated poses put it? If not, which simple slip would explain them?

The image of a silhouette and the projected scan overlap (Jaccard's index of both masks) by .97 and more where poses and
scan are right; objects of few pixels may do with less (`least_overlap`). Slips that people make - a mirrored frame, a
table that turns the other way, a scan with another axis up - are tried one by one, and each one's overlap is reported.
The check is as good as the object is irregular: a ball fits whatever the table does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import trimesh
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from hw.base.arrays import F64, Bool
from hw.record import RawImage, Sensor, to_radiance
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.geometry.silhouette import object_mask, pixel_grid, shifted_overlap
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.stream.stream import CorruptImage, StreamReader

GRID = 96  # pixels each way that are compared
MOST_VIEWS = 24  # spread over all
MISSES, EDGE_PX = 0.1, 0.25  # what a pose that may be right lacks of 1: at any size, and by the pixels of its edge
WHOLE = 0.9  # share of an image that the scan fills at most: beyond, no outline is left to compare
SLACK = 0.35  # of the object's size, that it may lie beside its place while the poses are still to be calibrated
BETTER = 0.5  # of what an overlap lacks, another explanation may leave at most to be the likeliest
DECISIVE = 0.9  # overlap of another explanation that leaves no doubt
HOPELESS = 0.2  # overlap below which no calibration finds the poses, as from another object's scan, or in other units


@dataclass(frozen=True)
class Silhouette:
    """One view's mask on a grid of pixels. mask: (R, C); pixels: (R * C, 2) x, y; share: of the image, by the scan."""

    view: int
    mask: Bool
    pixels: F64


@dataclass(frozen=True)
class SilhouetteFit:
    """What the silhouettes say. views, overlaps: of the stated poses; least: of poses that may be right; cameras: of
    the views that do not fit; others: overlap of every other explanation over these views, best first, and its remedy
    """

    views: tuple[int, ...]
    overlaps: tuple[float, ...]
    least: float = 0.0
    cameras: tuple[str, ...] = ()
    others: tuple[tuple[str, float, str], ...] = ()

    @property
    def fits(self) -> bool:
        """Whether every view does."""
        return min(self.overlaps, default=1.0) >= self.least

    @property
    def stated(self) -> float:
        """Mean overlap over the views that the other explanations are compared by."""
        return float(np.mean(self.overlaps)) if self.overlaps else 1.0

    @property
    def cause(self) -> tuple[str, float, str] | None:
        """The likeliest explanation; None where none is much better than the poses as stated."""
        best = self.others[0] if self.others else None
        return best if best is not None and 1 - best[1] < BETTER * (1 - self.stated) else None

    @property
    def decisive(self) -> bool:
        """Whether another explanation fits beyond doubt."""
        return not self.fits and self.cause is not None and self.cause[1] >= DECISIVE

    @property
    def hopeless(self) -> bool:
        """Whether scan and silhouettes have next to nothing in common."""
        return not self.fits and self.stated < HOPELESS

    @property
    def problem(self) -> str:
        """What is wrong, without the remedy."""
        low = min(self.overlaps)
        where = self.views[self.overlaps.index(low)]
        text = (
            f"the silhouettes of camera {', '.join(self.cameras)} do not show the scan at the stated poses: they "
            f"overlap it by {self.stated:.2f}, in view {where} by {low:.2f} (right poses: {self.least:.2f} and more)"
        )
        others = self.others
        if self.cause is not None:
            text += f"; likeliest cause: {self.cause[0]}"
        else:
            text, others = f"{text}; no simple slip explains them", others[:3]
        return text + "; overlaps with " + ", ".join(f"{name} {value:.2f}" for name, value, _ in others)

    @property
    def remedy(self) -> str:
        """What to do about it."""
        if self.cause is not None:
            return self.cause[2]
        return "check position_mm, aim_mm, up and focal_length_mm of the cameras, the angles and the scan's frame"

    def warnings(self) -> list[str]:
        """One line where a view does not fit; none where all do."""
        return [] if self.fits else [f"{self.problem}. Remedy: {self.remedy}"]


def silhouette(view: int, raw: RawImage, sensor: Sensor, share: float) -> Silhouette:
    """Of an image. share: of the image that the scan should fill."""
    rows, columns, pixels = pixel_grid(raw.charge.shape, GRID)
    mask = object_mask(to_radiance(raw, sensor, 0).radiance, share)
    return Silhouette(view, mask[np.ix_(rows, columns)], pixels)


def nominal_view(rig: RigConfig, view: int) -> PinholeCamera:
    """The camera of a view in the object frame."""
    camera, angle = divmod(view, len(rig.turntable_angles_deg))
    return PinholeCamera.from_config(rig.cameras[camera]).seen_from(turn(np.deg2rad(rig.turntable_angles_deg[angle])))


def least_overlap(mask: Bool) -> float:
    """Of a pose that may be right, for an object of this shape: of the pixels on its edge a part is always open."""
    edge = np.count_nonzero(mask & ~ndimage.binary_erosion(mask))
    return float(1 - MISSES - EDGE_PX * edge / max(int(np.count_nonzero(mask)), 1))


def chosen_views(plan: Plan) -> list[int]:
    """Views that are compared: all, or some spread over cameras and angles."""
    return [int(v) for v in np.unique(np.linspace(0, plan.views - 1, min(plan.views, MOST_VIEWS)).round())]


def examine_silhouettes(
    images: Iterable[tuple[int, RawImage]],
    sensor: Sensor,
    rig: RigConfig,
    mesh: trimesh.Trimesh,
    camera_of: Callable[[int], PinholeCamera] | None = None,
    slack: float = 0.0,
) -> SilhouetteFit:
    """Compare (view, image) pairs with the scan. camera_of: a view's camera where it is not the nominal one; slack: by
    how much of its size the object may lie beside its place.
    """
    surface, own = RayMesh.of(mesh), camera_of or (lambda view: nominal_view(rig, view))
    views, found, stated, least = [], [], [], 1.0
    for view, raw in images:
        rows, columns, pixels = pixel_grid(raw.charge.shape, GRID)
        expected = surface.meets(*own(view).rays(pixels)).reshape(len(rows), len(columns))
        if expected.mean() <= WHOLE:
            found.append(silhouette(view, raw, sensor, float(expected.mean())))
            stated.append(shifted_overlap(found[-1].mask, expected, slack))
            views.append(view)
            least = min(least, least_overlap(expected))
    fit = SilhouetteFit(tuple(views), tuple(stated), least)
    if fit.fits:
        return fit
    angles = len(rig.turntable_angles_deg)
    bad = sorted({view // angles for view, value in zip(views, stated, strict=True) if value < least})
    of_bad = [k for k, view in enumerate(views) if view // angles in bad]
    chosen = [found[k] for k in of_bad]
    others = _others(chosen, rig, mesh, own, bad, slack)
    return SilhouetteFit(
        tuple(views[k] for k in of_bad), tuple(stated[k] for k in of_bad), least,
        tuple(rig.cameras[c].name for c in bad),
        tuple(sorted(others, key=lambda other: -other[1])),
    )  # fmt: skip


def silhouettes_of(stream: StreamReader) -> Iterable[tuple[int, RawImage]]:
    """The silhouettes that a stream holds, finished or not, of the chosen views."""
    for view in chosen_views(stream.plan):
        address = ImageAddress(view, "silhouette")
        if stream.plan.index(address) < len(stream):
            try:
                yield view, stream.read(address)
            except CorruptImage:
                continue


# ---- other explanations

Rows = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
AS_IT_IS: Rows = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


@dataclass(frozen=True)
class Slip:
    """What people get wrong. rows, columns: whether the frames are to be flipped along them; dark: whether the object
    is darker than what is behind it; sign, offset_deg: of the angles; axes: (3, 3) stated frame of the scan -> the
    right one; exchanged: two cameras.
    """

    name: str
    remedy: str
    rows: bool = False
    columns: bool = False
    dark: bool = False
    sign: int = 1
    offset_deg: float = 0.0
    axes: Rows = AS_IT_IS
    exchanged: tuple[int, int] | None = None

    def flipped(self, mask: Bool) -> Bool:
        """A silhouette as it should have been delivered."""
        return np.asarray(mask[:: -1 if self.rows else 1, :: -1 if self.columns else 1] != self.dark)

    def camera(self, rig: RigConfig, view: int) -> PinholeCamera:
        """The camera that a view was really taken by."""
        camera, angle = divmod(view, len(rig.turntable_angles_deg))
        if self.exchanged is not None and camera in self.exchanged:
            camera = sum(self.exchanged) - camera
        turned = np.deg2rad(self.sign * rig.turntable_angles_deg[angle] + self.offset_deg)
        return PinholeCamera.from_config(rig.cameras[camera]).seen_from(turn(float(turned)))

    def scan(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """The scan in the right frame."""
        if self.axes == AS_IT_IS:
            return mesh
        return trimesh.Trimesh(np.asarray(mesh.vertices) @ np.array(self.axes, float).T, mesh.faces, process=False)


FRAMES = (
    Slip("mirrored frames", "switch mirroring off in the camera's driver, or mirror them back left to right",
         columns=True),
    Slip("upside-down frames", "switch flipping off in the driver, or exchange their top and bottom", rows=True),
    Slip("dark silhouettes", "light the object, not what is behind it", dark=True),
    Slip("frames turned by 180 deg", "turn them back, or negate the camera's up", rows=True, columns=True),
)  # fmt: skip
POSES = (
    Slip("a turntable that turns the other way", "give its angles the other sign", sign=-1),
    *(Slip(f"angles off by {by} deg", f"add {by} deg to the turntable's angles, or turn the scan into its frame",
           offset_deg=by) for by in (90, 180, 270)),
    Slip("a scan in cm", "export it in mm", axes=((10, 0, 0), (0, 10, 0), (0, 0, 10))),
    Slip("a scan in inches", "export it in mm", axes=((25.4, 0, 0), (0, 25.4, 0), (0, 0, 25.4))),
    *(Slip(f"a turntable the other way and off by {by} deg", f"give its angles the other sign and add {by} deg",
           sign=-1, offset_deg=by) for by in (90, 180, 270)),
    Slip("a scan with y up", "export it with z up", axes=((1, 0, 0), (0, 0, -1), (0, 1, 0))),
    Slip("a scan with x up", "export it with z up", axes=((0, 0, -1), (0, 1, 0), (1, 0, 0))),
    Slip("a scan on its head", "turn it over", axes=((1, 0, 0), (0, -1, 0), (0, 0, -1))),
    Slip("a mirrored scan", "export it without mirroring", axes=((1, 0, 0), (0, -1, 0), (0, 0, 1))),
)  # fmt: skip


def _others(
    found: Sequence[Silhouette], rig: RigConfig, mesh: trimesh.Trimesh, own: Callable[[int], PinholeCamera],
    bad: Sequence[int], slack: float,
) -> list[tuple[str, float, str]]:  # fmt: skip
    """Every slip with its overlap and its remedy; without those that change nothing here."""

    def projected(body: trimesh.Trimesh, camera: Callable[[int], PinholeCamera]) -> list[Bool]:
        surface = RayMesh.of(body)
        return [surface.meets(*camera(s.view).rays(s.pixels)).reshape(s.mask.shape) for s in found]

    def mean(masks: Sequence[Bool], expected: Sequence[Bool]) -> float:
        return float(np.mean([shifted_overlap(a, b, slack) for a, b in zip(masks, expected, strict=True)]))

    masks, stated = [s.mask for s in found], projected(mesh, own)
    out = [(slip.name, mean([slip.flipped(m) for m in masks], stated), slip.remedy) for slip in FRAMES]
    nominal = projected(mesh, lambda view: nominal_view(rig, view))
    pairs = [(a, b) for a in bad for b in bad if a < b]
    swaps = [
        Slip(f"the cameras {rig.cameras[a].name} and {rig.cameras[b].name} exchanged", "exchange their names in the "
             "table or in rig.cameras", exchanged=(a, b)) for a, b in pairs
    ]  # fmt: skip

    def tried(slip: Slip) -> tuple[str, float, str] | None:
        expected = projected(slip.scan(mesh), partial(slip.camera, rig))
        if all((a == b).all() for a, b in zip(expected, nominal, strict=True)):
            return None
        return slip.name, mean(masks, expected), slip.remedy

    out += [other for slip in (*POSES, *swaps) if (other := tried(slip)) is not None]
    turns = {by: other for by in range(15, 360, 15) if by % 90 and (other := tried(_turned(by))) is not None}
    if turns:
        coarse = max(turns, key=lambda by: turns[by][1])
        near = [turns[coarse], *(tried(_turned(coarse + by)) for by in (-10, -5, 5, 10) if (coarse + by) % 90)]
        out.append(max((other for other in near if other is not None), key=lambda other: other[1]))
    return [*out, *_reordered(found, nominal, len(rig.turntable_angles_deg), slack)]


def _turned(by: int) -> Slip:
    remedy = f"add {by} deg to the turntable's angles, or turn the scan into its frame"
    return Slip(f"angles off by {by} deg", remedy, offset_deg=by)


def _reordered(
    found: Sequence[Silhouette], expected: Sequence[Bool], angles: int, slack: float
) -> list[tuple[str, float, str]]:
    """The views of each camera in the order in which they fit best, if that is another one."""
    order, overlaps = dict[int, int](), list[float]()
    for camera in sorted({s.view // angles for s in found}):
        own = [k for k, s in enumerate(found) if s.view // angles == camera]
        table = np.array([[shifted_overlap(found[a].mask, expected[b], slack) for b in own] for a in own])
        rows, columns = linear_sum_assignment(-table)
        overlaps += table[rows, columns].tolist()
        order |= {found[own[a]].view: found[own[b]].view for a, b in zip(rows, columns, strict=True) if a != b}
    if not order:
        return []
    some = ", ".join(f"{a} is {b}" for a, b in list(order.items())[:4])
    return [(f"views in another order ({some})", float(np.mean(overlaps)), "correct angle_deg, or the frames' order")]
