"""Slips on purpose in every stage of the calibration: the stage's own score, or its z-score, sees each of them.

A slip has to raise the score by the factor that stands beside it, over what the unbroken stage scores in the same test,
or the stage has to refuse its input.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from calibrate_twin import (
    Glowing,
    Silhouettes,
    boards,
    capture_targets,
    faulty_rig,
    flickering_rig,
    floodlit,
    photograph,
    silhouettes,
    world,
)
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from test_calibrate_measure import true_axis
from test_calibrate_projector_fit import accuracy, fitted, lit
from trimesh.ray.ray_pyembree import RayMeshIntersector

from disco_twin.camera.lars3 import Lars3, lars3_sensor
from disco_twin.deviation import actual_rig
from disco_twin.object.scanner import scan_points
from hw.errors import DiscoError
from pipeline.calibrate import measure, outline, peaks, photometric, pose, projector_fit
from pipeline.calibrate.camera import PinholeCamera, turn
from pipeline.calibrate.geometry import _outside, reconstruct_surface
from pipeline.calibrate.intrinsics import find_corners, fit_intrinsics
from pipeline.calibrate.pose import fit_poses
from pipeline.calibrate.projector import TwoMirrorProjector
from pipeline.capture.layout import ImageMeta
from pipeline.capture.plan import ImageAddress
from pipeline.capture.stream import StreamReader
from pipeline.capture.targets import Targets
from pipeline.rig import RigConfig

F64 = NDArray[np.float64]
Patch = pytest.MonkeyPatch
Slip = Callable[[Patch], None]


def require_seen(score: Callable[[], float], good: float, factor: float) -> None:
    """The broken stage scores worse by the factor, a finite number, or refuses by a named error."""
    try:
        bad = score()
    except DiscoError:
        return
    assert np.isfinite(bad)
    assert bad > factor * good


# Photometric


@dataclass(frozen=True)
class Plates:
    """A camera's target capture, with the lens and the plates' places as they are."""

    folder: Path
    rig: RigConfig
    targets: Targets
    lens: PinholeCamera
    poses: dict[int, F64]
    truth: F64  # (L,) factors

    def scores(self) -> tuple[float, float]:
        """Largest error of the white balance, and largest scatter about the photodiode, as shares."""
        with StreamReader(self.folder) as stream:
            sensor = lars3_sensor(self.rig)
            found = measure._plates(stream, self.targets, sensor, self.lens, self.poses, self.rig)[0]
        return float(np.abs(found.factor / self.truth - 1).max()), float(found.scatter.max())


@pytest.fixture(scope="module")
def plates(tmp_path_factory: pytest.TempPathFactory) -> Plates:
    folder = tmp_path_factory.mktemp("targets")
    rig = flickering_rig()
    targets, source = capture_targets(folder, rig, 11, 0)
    actual = actual_rig(rig, 11)
    lens = replace(actual.cameras[0], pose=PinholeCamera.from_config(rig.cameras[0]).pose)
    poses = {i: actual.cameras[0].pose @ source.pose(i) for i, p in enumerate(targets.placements) if p.kind == "white"}
    return Plates(folder, rig, targets, lens, poses, actual.photodiode / actual.response[0])


def cosine_left_out(patch: Patch) -> None:
    real = photometric.pixel_areas

    def broken(camera: PinholeCamera, plane: F64) -> F64:
        xy = camera.undistort((camera.pixel_centres() - camera.centre) / camera.focal)
        slope = np.abs(np.column_stack([xy, np.ones(len(xy))]) @ plane[:3, 2])
        return np.asarray(real(camera, plane) * slope.reshape(camera.height, camera.width))

    patch.setattr(measure, "pixel_areas", broken)


def sides_confused(patch: Patch) -> None:
    real = measure._same_side
    patch.setattr(measure, "_same_side", lambda *arguments: not real(*arguments))


def lasers_swapped(patch: Patch) -> None:
    real = photometric.balance
    patch.setattr(measure, "balance", lambda light, reading, *more: real(light, reading[::-1], *more))


def factor_upside_down(patch: Patch) -> None:
    real = photometric.balance

    def broken(*arguments: F64) -> photometric.Balance:
        found = real(*arguments)  # type: ignore[arg-type]
        return replace(found, factor=1 / found.factor)

    patch.setattr(measure, "balance", broken)


PHOTOMETRIC: dict[str, tuple[float, int, Slip]] = {
    "cosine left out": (4, 0, cosine_left_out),
    "lit side for the far side": (20, 0, sides_confused),
    "lasers in the wrong order": (5, 1, lasers_swapped),
    "factor upside down": (10, 0, factor_upside_down),
}


@pytest.mark.parametrize("name", PHOTOMETRIC)
def test_photometric_slips_show(name: str, plates: Plates, monkeypatch: Patch) -> None:
    good = plates.scores()
    assert good[0] < 0.0075
    assert good[1] < 0.012
    factor, which, slip = PHOTOMETRIC[name]
    slip(monkeypatch)
    require_seen(lambda: plates.scores()[which], good[which], factor)


def test_vignetting_upside_down_shows() -> None:
    """Against what the twin's lens does: the spots on the plate are too near the axis to tell (.1 % of the balance)."""
    rig = faulty_rig()
    lens = actual_rig(rig, 11).cameras[0]
    true = Lars3.of(rig, lens).vignetting

    def off(seen: F64) -> float:
        return float(np.abs(seen / seen.max() * (true.max() / true) - 1).max())

    good = off(measure.illumination(lens))
    assert good < 1e-3
    require_seen(lambda: off(1.0 / measure.illumination(lens)), max(good, 1e-3), 5)


@pytest.mark.parametrize("reading", [0.0, float("nan")])
def test_a_photodiode_that_reads_nothing_is_named(reading: float, plates: Plates, monkeypatch: Patch) -> None:
    """At the first exposure alone: that spot is left out. At all of them: one line."""
    real, good = StreamReader.meta, plates.scores()[0]

    def first(self: StreamReader, which: ImageAddress) -> ImageMeta:
        dead = which == ImageAddress(which.view, "spot", 0, 0)
        return replace(real(self, which), photodiode_w=reading) if dead else real(self, which)

    monkeypatch.setattr(StreamReader, "meta", first)
    assert plates.scores()[0] < 2 * good + 0.005
    monkeypatch.setattr(StreamReader, "meta", lambda *a: replace(real(*a), photodiode_w=reading))
    with pytest.raises(DiscoError, match=r"photodiode read nothing.*Remedy"):
        plates.scores()


# Intrinsics and distortion


Corners = tuple[list[F64 | None], F64, PinholeCamera, PinholeCamera]


@pytest.fixture(scope="module")
def corners() -> Corners:
    rig = faulty_rig()
    targets, images, actual = boards(11, rig, 0)
    board = targets.corners()
    return [find_corners(image, board) for image in images], board, actual, PinholeCamera.from_config(rig.cameras[0])


def lens_scores(corners: Corners) -> tuple[float, float]:
    """Reprojection in pixels, and the largest z-score of focal length, centre and k1."""
    found_corners, board, actual, nominal = corners
    found = fit_intrinsics(found_corners, board, nominal)
    truth = np.array([actual.focal[0], *actual.centre, actual.distortion[0]])
    return found.reprojection_px, float(np.abs((found.values - truth) / np.sqrt(np.diag(found.covariance))).max())


def seen_as(change: Callable[[F64], F64]) -> Callable[[list[F64 | None]], list[F64 | None]]:
    return lambda found: [None if c is None else change(c) for c in found]


INTRINSICS = {
    "axes swapped": (5.0, 1, seen_as(lambda c: c[:, ::-1])),
    "rows for columns": (100.0, 0, seen_as(lambda c: c.reshape(6, 11, 2).transpose(1, 0, 2).reshape(-1, 2))),
    "half a pixel in every other row": (
        10.0,
        0,
        seen_as(lambda c: c + 0.5 * np.repeat(np.arange(6) % 2, 11)[:, None]),
    ),
}


@pytest.mark.parametrize("name", INTRINSICS)
def test_intrinsic_slips_show(name: str, corners: Corners) -> None:
    """Swapped axes look like the board seen from behind; the lens's centre then is off by many sigmas."""
    good = lens_scores(corners)
    assert good[0] < 0.15
    assert good[1] < 4
    factor, which, slip = INTRINSICS[name]
    least = (0.0, 1.0)[which]
    require_seen(lambda: lens_scores((slip(corners[0]), *corners[1:]))[which], max(good[which], least), factor)


def test_a_distortion_of_the_wrong_sign_shows(corners: Corners, monkeypatch: Patch) -> None:
    """Boards through a lens that bends ten times as much as the rig's; seen again through the lens that was found."""
    found_corners, board, actual, nominal = corners
    strong = replace(actual, distortion=np.array([-0.6, 0, 0, 0, 0]))
    bent = [
        None
        if c is None
        else strong.distort(actual.undistort((c - actual.centre) / actual.focal)) * actual.focal + actual.centre
        for c in found_corners
    ]
    found = fit_intrinsics(bent, board, replace(nominal, distortion=0.9 * strong.distortion))
    assert abs(found.values[3] + 0.6) < 4 * np.sqrt(found.covariance[3, 3])

    def again() -> float:
        lens = found.lens(nominal)
        away = [
            replace(lens, pose=place).project(board)[0] - bent[i]
            for place, i in zip(found.poses, found.used, strict=True)
        ]
        return float(np.sqrt((np.concatenate(away) ** 2).sum(axis=1).mean()))

    good, real = again(), PinholeCamera.distort
    assert good < 0.15
    monkeypatch.setattr(PinholeCamera, "distort", lambda self, xy: real(replace(self, distortion=-self.distortion), xy))
    require_seen(again, good, 5)


# Pose and axis


@cache
def one_camera() -> Silhouettes:
    return silhouettes(4, world().scan, faulty_rig().model_copy(update={"cameras": faulty_rig().cameras[:1]}))


def pose_score(
    start: Callable[[PinholeCamera], PinholeCamera] | None = None, mesh: trimesh.Trimesh | None = None
) -> float:
    """rms of the edges in pixels."""
    seen = one_camera()
    lens = start(seen.lenses[0]) if start else seen.lenses[0]
    return fit_poses(seen.images[:3], mesh or world().scan, [lens], seen.angles).residual_px


def transposed(lens: PinholeCamera) -> PinholeCamera:
    matrix = lens.pose.copy()
    matrix[:3, :3] = matrix[:3, :3].T
    return replace(lens, pose=matrix)


def wrong_way_round(patch: Patch) -> None:
    patch.setattr(pose, "turn", lambda angle: turn(-angle))


def degrees(patch: Patch) -> None:
    patch.setattr(pose, "turn", lambda angle: turn(np.rad2deg(angle)))


def edges_upside_down(patch: Patch) -> None:
    real = outline.edges_along
    patch.setattr(pose, "edges_along", lambda image, pixel, normal: real(image, pixel, -normal))


POSE: dict[str, tuple[float, Slip | None, Callable[[PinholeCamera], PinholeCamera] | None, Callable[[F64], F64] | None]]
POSE = {
    "pose transposed": (3, None, transposed, None),
    "image mirrored": (3, None, lambda lens: replace(lens, focal=lens.focal * [-1, 1]), None),
    "axis turned the wrong way": (3, wrong_way_round, None, None),
    "axis in degrees": (3, degrees, None, None),
    "normals inwards": (3, edges_upside_down, None, None),
    "scan: axes swapped": (3, None, None, lambda v: v[:, [1, 0, 2]] * [1, -1, 1] * [1, 1, -1]),
    "scan: one per cent too large": (1.5, None, None, lambda v: v * [1.01, 1.01, 1.0]),
    "scan: half a millimetre beside its axis": (1.5, None, None, lambda v: v + 0.5 * np.sign(v) * [1, 0, 0]),
}


@pytest.fixture(scope="module")
def good_pose() -> float:
    return pose_score()


@pytest.mark.parametrize("name", POSE)
def test_pose_axis_and_scan_slips_show(name: str, good_pose: float, monkeypatch: Patch) -> None:
    assert good_pose < 0.06
    factor, slip, start, change = POSE[name]
    mesh = None
    if change is not None:
        mesh = trimesh.Trimesh(change(np.asarray(world().scan.vertices)), world().scan.faces, process=False)
    if slip is not None:
        slip(monkeypatch)
    require_seen(lambda: pose_score(start, mesh), good_pose, factor)


def test_half_a_pixel_shows_in_the_z_scores() -> None:
    """A pose can follow half a pixel without a trace in its edges: its own figures then are off by many sigmas."""
    seen, mesh = one_camera(), world().scan

    def score(centre: float) -> float:
        lens = replace(seen.lenses[0], centre=seen.lenses[0].centre + centre)
        found = fit_poses(seen.images[:3], mesh, [lens], seen.angles)
        across = found.views[0].pose[:2, 3] - seen.truth[0].pose[:2, 3]
        return float(np.abs(across / found.translation[0, :2]).max())

    good = max(score(0.0), 1.0)
    assert good < 4
    require_seen(lambda: score(0.5), good, 20)


def test_slips_of_the_axis_show_in_its_z_scores() -> None:
    """A turntable that leans by two degrees: found; with swapped axes, the wrong sign or in degrees it is not."""
    rig = faulty_rig()
    mesh, camera = world().object.mesh, PinholeCamera.from_config(rig.cameras[0])
    lean = np.eye(4)
    lean[:3, :3] = Rotation.from_rotvec(np.deg2rad([1.5, -0.6, 0.0])).as_matrix()
    angles = [float(a) for a in np.deg2rad(rig.turntable_angles_deg)]
    turns = [lean @ turn(a) @ np.linalg.inv(lean) for a in angles]
    images = [photograph(rig, camera.seen_from(t), floodlit(mesh, camera.seen_from(t)), k) for k, t in enumerate(turns)]
    found, (tilt, _) = fit_poses(images, mesh, [camera], angles), true_axis(turns)

    def score(axis: F64) -> float:
        return float(np.abs((axis - tilt) / found.axis_error[:2]).max())

    good = max(score(found.axis[:2]), 1.0)
    assert good < 4
    for slip in (found.axis[1::-1], -found.axis[:2], np.rad2deg(found.axis[:2])):
        assert score(slip) > 5 * good


# Projector


def step_score(change: Callable[[F64], F64] = lambda steps: steps, separation: float = 1.0) -> float:
    """Largest z-score of the two full angles, from spots on a plane."""
    nominal, grid, place = ON_A_PLANE
    given = replace(nominal, separation_mm=separation * nominal.separation_mm)
    found = projector_fit.step_size(place, change(grid), DEPTH_ALONE, given, 0.02)
    return float(np.abs((found.full_angle_rad - nominal.full_angle_rad * TRUE_ANGLES) / found.error_rad).max())


TRUE_ANGLES = np.array([1.003, 0.996])
DEPTH_ALONE = np.diag([0, 0, 0, 0, 0, 0.5**2])


def _on_a_plane() -> tuple[TwoMirrorProjector, F64, F64]:
    nominal = TwoMirrorProjector.from_config(faulty_rig().projector)
    truth = replace(nominal, full_angle_rad=nominal.full_angle_rad * TRUE_ANGLES, pose=np.eye(4))
    grid = np.stack(np.meshgrid(np.linspace(500, 3600, 5), np.linspace(500, 3600, 5)), axis=-1).reshape(-1, 2)
    origin, way = truth.rays(grid)
    place = origin + ((600 - origin[:, 2]) / way[:, 2])[:, None] * way
    place[:, :2] += 0.02 * np.random.default_rng(3).standard_normal((25, 2))
    return nominal, grid, place


ON_A_PLANE = _on_a_plane()
STEP: dict[str, Callable[[], float]] = {
    "axes swapped": lambda: step_score(lambda steps: steps[:, ::-1]),
    "wrong sign": lambda: step_score(lambda steps: 4095 - steps),
    "degrees for radians": lambda: step_score(lambda steps: np.rad2deg(steps - 2047.5) + 2047.5),
    "one pivot for both mirrors": lambda: step_score(separation=0.0),
}


@pytest.mark.parametrize("name", STEP)
def test_step_size_slips_show(name: str) -> None:
    good = max(step_score(), 1.0)
    assert good < 3
    require_seen(STEP[name], good, 5)


def thesis_fourth_column(points: F64, steps: F64) -> F64:
    """As printed: 1, 2, 3 where all must be 1, and t3 fixed at 1."""
    homogeneous = np.column_stack([points, np.resize([1.0, 2.0, 3.0], len(points))])
    none = np.zeros_like(homogeneous)
    rows = np.concatenate(
        [
            np.hstack([homogeneous, none, -steps[:, :1] * points]),
            np.hstack([none, homogeneous, -steps[:, 1:] * points]),
        ]
    )
    solved = np.linalg.lstsq(rows, steps.T.ravel(), rcond=None)[0]
    return np.append(solved, 1.0).reshape(3, 4)


def matrix_score() -> float:
    """mm from the matrix's centre to where the projector stands."""
    spots = lit(7, noise=0.02, false=0.1)
    found = projector_fit.projection(spots.points, spots.steps, 40.0, np.random.default_rng(0))
    true = spots.actual
    return float(np.linalg.norm(found.centre + true.pose[:3, :3].T @ true.pose[:3, 3]))


def not_transposed_back(points: F64, steps: F64) -> F64:
    here, there = projector_fit._normaliser(points), projector_fit._normaliser(steps)
    real = DLT(points, steps)
    return np.asarray(np.linalg.inv(there) @ (there @ real @ np.linalg.inv(here)) @ here.T)


DLT = projector_fit.dlt
MATRIX: dict[str, Callable[[F64, F64], F64]] = {
    "fourth column of the thesis": thesis_fourth_column,
    "axes swapped": lambda points, steps: DLT(points[:, [1, 0, 2]], steps),
    "normaliser transposed": not_transposed_back,
    "centre from t": lambda points, steps: np.column_stack([DLT(points, steps)[:, :3], -DLT(points, steps)[:, 3]]),
}


@pytest.mark.parametrize("name", MATRIX)
def test_projection_matrix_slips_show(name: str, monkeypatch: Patch) -> None:
    good = matrix_score()
    assert good < 60  # of 600: two mirrors are no pinhole
    monkeypatch.setattr(projector_fit, "dlt", MATRIX[name])
    require_seen(matrix_score, good, 3)


def two_mirror_score() -> float:
    """mm, rms of predicted spots on the surface."""
    spots = lit(5)
    return accuracy(fitted(spots), spots)[0]


def rays_of(change: Callable[[F64, F64], tuple[F64, F64]]) -> Slip:
    real = TwoMirrorProjector.rays
    return lambda patch: patch.setattr(projector_fit.TwoMirrorProjector, "rays", lambda self, s: change(*real(self, s)))


def test_two_mirror_slips_show(monkeypatch: Patch) -> None:
    """Axes swapped, sign, degrees and a transposed pose: those in the fit itself, judged by the true projector."""
    spots, good = lit(5), two_mirror_score()
    assert good < 0.15
    slips: dict[str, Callable[[TwoMirrorProjector, F64], F64]] = {
        "axes swapped": lambda p, s: REAL_ANGLES(p, s)[:, ::-1],
        "wrong sign": lambda p, s: REAL_ANGLES(p, s) * [1, -1],
        "degrees": lambda p, s: np.rad2deg(REAL_ANGLES(p, s)),
        "five steps": lambda p, s: REAL_ANGLES(p, s + np.linspace(-5, 5, len(s))[:, None]),
    }
    for name, slip in slips.items():
        monkeypatch.setattr(TwoMirrorProjector, "angles", slip)
        try:
            fit = fitted(spots)
            bad = fit.rms_mm * (1 + 10 * fit.false.mean())
        except DiscoError:
            bad = np.inf
        monkeypatch.setattr(TwoMirrorProjector, "angles", REAL_ANGLES)
        if np.isfinite(bad):
            bad = max(bad, accuracy(fit, spots)[0])
        assert bad > 2 * good, name


REAL_ANGLES = TwoMirrorProjector.angles


# Geometry of the scan


def surface_score(change: Callable[[F64, F64], tuple[F64, F64]]) -> float:
    """mm, rms distance of points of the object from the mesh."""
    points, normals = scan_points(world().object.mesh, 3)
    found = reconstruct_surface(*change(points, normals), 800).mesh
    return float(np.sqrt((_outside(found, np.asarray(world().object.mesh.vertices)[::40]) ** 2).mean()))


@pytest.mark.parametrize("name", ["normals' axes swapped", "half a millimetre deep"])
def test_scan_slips_show(name: str) -> None:
    good = surface_score(lambda p, n: (p, n))
    assert good < 0.2
    change: dict[str, Callable[[F64, F64], tuple[F64, F64]]] = {
        "normals' axes swapped": lambda p, n: (p, n[:, [1, 2, 0]]),
        "half a millimetre deep": lambda p, n: (p - 0.5 * n, n),
    }
    require_seen(lambda: surface_score(change[name]), good, 2)


# Hidden spots


@dataclass(frozen=True)
class Hidden:
    """Peaks of spots as both cameras see them; visible: whether each sees the spot itself, by ray casting."""

    peaks: list[peaks.Peak]
    power: F64
    beam_px: float
    visible: NDArray[np.bool_]

    def score(self) -> float:
        """Share of the images that are taken for what they are not."""
        bright = measure.brightness(self.peaks, self.power)
        return float((measure.seen(self.peaks, self.power, self.beam_px, bright) != self.visible).mean())


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    rig = faulty_rig(angles=(0.0,))
    actual, mesh = actual_rig(rig, 6), world().object.mesh
    source, caster = Glowing(rig, actual, mesh), RayMeshIntersector(mesh)
    found, visible, power = [], [], []
    rng = np.random.default_rng(4)
    aims = [a for a in world().plan.spots if a.angle == 0][::2]
    for camera in range(2):
        eye = actual.camera(camera, 0).position
        for aim in aims:
            origin, way = actual.spot_rays([aim])
            spot, _, face = caster.intersects_location(origin, way, multiple_hits=False)
            if not len(face):
                continue
            towards = eye - spot[0]
            towards /= np.linalg.norm(towards)
            normal = mesh.face_normals[face[0]]
            blocked = caster.intersects_any((spot[0] + 1e-3 * normal)[None], towards[None])[0]
            if abs(normal @ towards) < 0.15:
                continue  # at the rim either answer is right
            watts = float(rng.uniform(0.004, 0.012))
            image = source.image(camera, aim, 0) * watts
            found.append(peaks.find_peak(image + 2e-7 * rng.standard_normal(image.shape)))
            visible.append(bool(normal @ towards > 0 and not blocked))
            power.append(watts)
    beam = rig.projector.beam_diameter_mm * actual.cameras[0].focal[0] / 450.0
    return Hidden(found, np.array(power), float(beam), np.array(visible))


def each_camera_by_itself(patch: Patch) -> None:
    patch.setattr(measure, "brightness", lambda p, power: 0.0)


HIDDEN: dict[str, Slip] = {
    "no measure of what is bright": each_camera_by_itself,
    "power in milliwatts": lambda patch: patch.setattr(
        measure, "seen", lambda p, power, beam, bright: peaks.seen(p, 1e3 * power, beam, bright)
    ),
    "sign": lambda patch: patch.setattr(measure, "seen", lambda *a: ~peaks.seen(*a)),
    "beam in metres": lambda patch: patch.setattr(
        measure, "seen", lambda p, power, beam, bright: peaks.seen(p, power, beam * 1e3, 0.0)
    ),
}


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_spot_slips_show(name: str, hidden: Hidden, monkeypatch: Patch) -> None:
    good = max(hidden.score(), 0.02)
    assert 0.2 < hidden.visible.mean() < 0.8
    assert good < 0.06
    HIDDEN[name](monkeypatch)
    require_seen(hidden.score, good, 5)
