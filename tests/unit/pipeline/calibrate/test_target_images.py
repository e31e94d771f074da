"""White balance from the white plate's images, the lens's vignetting, and a photodiode that fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from calibrate_twin import (
    capture_targets,
    faulty_rig,
    flickering_rig,
)
from numpy.typing import NDArray

from disco_twin.camera.lars3 import Lars3, lars3_sensor
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.errors import DiscoError
from pipeline.calibrate import target_images
from pipeline.geometry.camera import PinholeCamera
from pipeline.plan.plan import ImageAddress
from pipeline.plan.targets import Targets
from pipeline.stream.layout import ImageMeta
from pipeline.stream.stream import StreamReader

F64 = NDArray[np.float64]


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


@pytest.fixture(scope="module")
def good(plates: Plates) -> tuple[float, float]:
    """Error and scatter of the plates as they were taken."""
    return plates.scores()


def test_the_white_balance_is_the_rigs(good: tuple[float, float]) -> None:
    """Expected: factors within .75 %, and a scatter about the photodiode of at most 1.2 %."""
    error, scatter = good
    assert error < 0.0075
    assert scatter < 0.012


def test_the_lens_darkens_as_the_twins_does() -> None:
    """The spots on the plate are too near the axis to show it (.1 % of the balance)."""
    rig = faulty_rig()
    lens = actual_rig(rig, 11).cameras[0]
    true, seen = Lars3.of(rig, lens).vignetting, lens.illumination()
    np.testing.assert_allclose(seen / seen.max(), true / true.max(), rtol=1e-3)


@pytest.mark.parametrize("reading", [0.0, float("nan")])
def test_a_photodiode_that_reads_nothing_is_named(
    reading: float, plates: Plates, good: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the first exposure alone: that spot is left out. At all of them: one line."""
    real = StreamReader.meta

    def first(self: StreamReader, which: ImageAddress) -> ImageMeta:
        dead = which == ImageAddress(which.view, "spot", 0, 0)
        return replace(real(self, which), photodiode_w=reading) if dead else real(self, which)

    monkeypatch.setattr(StreamReader, "meta", first)
    assert plates.scores()[0] < 2 * good[0] + 0.005
    monkeypatch.setattr(StreamReader, "meta", lambda *a: replace(real(*a), photodiode_w=reading))
    with pytest.raises(DiscoError, match=r"photodiode read nothing.*Remedy"):
        plates.scores()
