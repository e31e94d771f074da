"""Slips on purpose in the photometric calibration.

The stage's own score, or its z-score, sees each of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from calibrate_slips import F64, Patch, Slip, require_seen
from calibrate_twin import (
    capture_targets,
    faulty_rig,
    flickering_rig,
)

from disco_twin.camera.lars3 import Lars3, lars3_sensor
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.errors import DiscoError
from pipeline.calibrate import photometric, target_images
from pipeline.geometry.camera import PinholeCamera
from pipeline.plan.plan import ImageAddress
from pipeline.plan.targets import Targets
from pipeline.stream.layout import ImageMeta
from pipeline.stream.stream import StreamReader


@dataclass(frozen=True)
class Plates:
    """A camera's target capture, with the lens and the plates' places as they are."""

    folder: Path
    rig: TwinRigConfig
    targets: Targets
    lens: PinholeCamera
    poses: dict[int, F64]
    truth: F64  # (L,) factors

    def scores(self) -> tuple[float, float]:
        """Largest error of the white balance, and largest scatter about the photodiode, as shares."""
        with StreamReader(self.folder) as stream:
            sensor = lars3_sensor(self.rig)
            found = target_images._plates(stream, self.targets, sensor, self.lens, self.poses, self.rig)[0]
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

    patch.setattr(target_images, "pixel_areas", broken)


def sides_confused(patch: Patch) -> None:
    real = target_images._same_side
    patch.setattr(target_images, "_same_side", lambda *arguments: not real(*arguments))


def lasers_swapped(patch: Patch) -> None:
    real = photometric.balance
    patch.setattr(target_images, "balance", lambda light, reading, *more: real(light, reading[::-1], *more))


def factor_upside_down(patch: Patch) -> None:
    real = photometric.balance

    def broken(*arguments: F64) -> photometric.Balance:
        found = real(*arguments)  # type: ignore[arg-type]
        return replace(found, factor=1 / found.factor)

    patch.setattr(target_images, "balance", broken)


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

    good = off(target_images.illumination(lens))
    assert good < 1e-3
    require_seen(lambda: off(1.0 / target_images.illumination(lens)), max(good, 1e-3), 5)


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
