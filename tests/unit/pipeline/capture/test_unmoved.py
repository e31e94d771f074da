"""The reference spot on resuming: figures of known displacements, no false alarm, and a rig that has moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from capture_fakes import contents
from numpy.typing import NDArray
from twin_fakes import PLAN, RIG, Glow

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.twin_rig import TwinRig
from hw.base.errors import DiscoError
from hw.interface import Aim
from hw.record import Sensor
from pipeline.capture.loop import capture
from pipeline.capture.unmoved import RigMoved, SpotComparison, compare
from pipeline.plan.plan import Plan
from pipeline.stream.stream import StreamReader, StreamWriter

SENSOR = lars3_sensor(RIG)


def spot(right: float = 0.0, down: float = 0.0) -> NDArray[np.float64]:
    """(62, 96) a translucent object's response to a spot: an exponential with texture, moved as a whole."""
    row, column = np.mgrid[:62, :96].astype(float)
    row, column = row - down, column - right
    distance = np.hypot(row - 30, column - 45)
    return np.asarray(np.exp(-distance / 6) * (1 + 0.2 * np.sin(column / 3) * np.cos(row / 4)))


@pytest.mark.parametrize(("right", "down"), [(0.0, 0.0), (0.3, -0.2), (-0.7, 0.4), (3.4, -5.2), (-12.3, 8.8)])
@pytest.mark.parametrize("gain", [1.0, 0.8, 1.3])
def test_displacement_and_brightness_are_measured(right: float, down: float, gain: float) -> None:
    result = compare(spot(), gain * spot(right, down), np.zeros((62, 96)), 1.0)
    assert result.shift_px == pytest.approx((right, down), abs=0.03)
    assert result.radiance == pytest.approx(gain, rel=0.01)
    assert result.pattern < 0.05
    assert result.moved == (np.hypot(right, down) > 0.5 or gain != 1.0)


def test_noise_alone_is_no_movement() -> None:
    """Rationale: 300 pairs of one image with 5 % noise at its peak. Expected: no alarm, no bias of the shift."""
    random, image, sigma = np.random.default_rng(3), spot(), 0.05
    results = []
    for _ in range(300):
        then, now = (image + sigma * random.standard_normal(image.shape) for _ in range(2))
        results.append(compare(then, now, np.full(image.shape, 2 * sigma**2), 1.0))
    assert not any(result.moved for result in results)
    shifts = np.array([result.shift_px for result in results])
    assert np.abs(shifts.mean(axis=0) / (shifts.std(axis=0) / np.sqrt(300))).max() < 4
    assert shifts.std() < 0.1


def test_another_pattern_in_the_same_place_is_noticed() -> None:
    turned = spot()[::-1, ::-1]
    assert compare(spot(), turned, np.zeros((62, 96)), 1.0).moved


@pytest.mark.parametrize("figure", [{"power": 0.7}, {"radiance": 1.2}, {"shift_px": (0.0, 0.6)}, {"pattern": 0.2}])
def test_every_figure_has_a_tolerance_and_nan_is_beyond_it(figure: dict[str, object]) -> None:
    good: dict[str, object] = {"power": 1.0, "radiance": 1.0, "shift_px": (0.1, 0.1), "pattern": 0.05}
    assert not SpotComparison(**good).moved  # type: ignore[arg-type]
    assert SpotComparison(**good | figure).moved  # type: ignore[arg-type]
    assert SpotComparison(**good | {"radiance": float("nan")}).moved  # type: ignore[arg-type]


class Moved(Glow):
    """An object that was pushed by some pixels."""

    def image(self, camera: int, aim: Aim, laser: int) -> NDArray[np.float32]:
        return np.roll(super().image(camera, aim, laser), 3, axis=1)


def interrupted(folder: Path, at: int) -> None:
    with pytest.raises(RuntimeError, match="out of light"):
        capture(Emulation(TwinRig(RIG, Glow(at), seed=5)).serial_rig(), PLAN, folder)


@pytest.mark.parametrize("at", [1, 2, 5, 8, 11, 12, 21])
def test_resuming_with_the_reference_gives_the_same_bytes(tmp_path: Path, at: int) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, whole)
    interrupted(parts, at)
    for make in (lambda twin: twin, lambda twin: Emulation(twin).serial_rig()):
        with StreamWriter(parts, PLAN) as stream:
            before = len(stream)
        assert capture(make(TwinRig(RIG, Glow(), seed=5)), PLAN, parts, sensor=SENSOR) == before
    assert contents(parts) == contents(whole)


def test_a_rig_that_has_moved_is_refused_with_the_figures_and_nothing_is_stored(tmp_path: Path) -> None:
    interrupted(tmp_path, 9)
    before = contents(tmp_path)
    emulation = Emulation(TwinRig(RIG, Moved(), seed=5))
    with pytest.raises(RigMoved, match=r"changed since image \d+ .*moved by \+3.0\d, [+-]0.0\d px \(0.5\).*Remedy"):
        capture(emulation.serial_rig(), PLAN, tmp_path, sensor=SENSOR)
    assert contents(tmp_path) == before
    assert emulation.bench.light() == [] and emulation.bench.hazards == []


def test_a_weaker_laser_is_refused(tmp_path: Path) -> None:
    interrupted(tmp_path, 9)
    twin = TwinRig(RIG, Glow(), seed=5)
    emulation = Emulation(twin)
    watts = twin.watts
    twin.watts = lambda laser, time_s: 0.7 * watts(laser, time_s)
    with pytest.raises(RigMoved, match=r"laser power -(29|30)\.\d % \(allowed: 20\)"):
        capture(emulation.serial_rig(), PLAN, tmp_path, sensor=SENSOR)


def test_every_laser_is_compared(tmp_path: Path) -> None:
    """Rationale: half of one laser's light lost behind its photodiode. Expected: refused, whichever laser it is."""
    interrupted(tmp_path, 9)
    before = contents(tmp_path)

    class Weaker(Glow):
        def __init__(self, weak: int) -> None:
            super().__init__()
            self.weak = weak

        def image(self, camera: int, aim: Aim, laser: int) -> NDArray[np.float32]:
            return super().image(camera, aim, laser) * np.float32(0.5 if laser == self.weak else 1.0)

    for laser in range(3):
        emulation = Emulation(TwinRig(RIG, Weaker(laser), seed=5))
        with pytest.raises(RigMoved, match=rf"laser {laser}\).*radiance per watt -(49|50)\.\d %.*Remedy"):
            capture(emulation.serial_rig(), PLAN, tmp_path, sensor=SENSOR)
        assert contents(tmp_path) == before and emulation.bench.light() == []


def test_nothing_bright_enough_is_refused(tmp_path: Path) -> None:
    """Unless nothing but a silhouette is stored."""
    blind = Sensor(**SENSOR.__dict__ | {"read_noise_e": 1e9})
    interrupted(tmp_path / "spots", 5)
    with pytest.raises(RigMoved, match=r"no stored spot is bright enough.*Remedy"):
        capture(Emulation(TwinRig(RIG, Glow(), seed=5)).serial_rig(), PLAN, tmp_path / "spots", sensor=blind)
    interrupted(tmp_path / "none", 1)
    capture(Emulation(TwinRig(RIG, Glow(), seed=5)).serial_rig(), PLAN, tmp_path / "none", sensor=blind)


def test_earlier_views_are_looked_at_where_the_last_one_is_dim(tmp_path: Path) -> None:
    """Rationale: the second camera sees nothing of 36 spots. Expected: the first one's tell that the rig has moved."""
    aims = tuple(Aim(k * 2 // 24, 1900 + 10 * k, 2000) for k in range(24))
    plan = Plan(("front", "back"), (0.0, float(np.pi)), aims, lasers=3)

    class Dim(Moved):
        def __init__(self, fail_at: int, pixels: int) -> None:
            super().__init__(fail_at)
            self.pixels = pixels

        def image(self, camera: int, aim: Aim, laser: int) -> NDArray[np.float32]:
            image = Glow.image(self, camera, aim, laser) * np.float32(1e-9 if camera else 1.0)
            return np.roll(image, self.pixels, axis=1)

    with pytest.raises(RuntimeError, match="out of light"):
        capture(Emulation(TwinRig(RIG, Dim(74 + 36, 0), seed=5)).serial_rig(), plan, tmp_path)
    with pytest.raises(RigMoved, match=r"view 1, .*moved by \+3.0"):
        capture(Emulation(TwinRig(RIG, Dim(-1, 3), seed=5)).serial_rig(), plan, tmp_path, sensor=SENSOR)
    with pytest.raises(RuntimeError, match="out of light"):
        capture(Emulation(TwinRig(RIG, Dim(5, 0), seed=5)).serial_rig(), plan, tmp_path, sensor=SENSOR)
    assert len(StreamReader(tmp_path)) == 74 + 36 + 2  # three were references


class Absorbed(Glow):
    """An object that is black in one laser's light."""

    def __init__(self, black: int, fail_at: int = -1) -> None:
        super().__init__(fail_at)
        self.black = black

    def image(self, camera: int, aim: Aim, laser: int) -> NDArray[np.float32]:
        return super().image(camera, aim, laser) * np.float32(1e-9 if laser == self.black else 1.0)


def weaker(twin: TwinRig, laser: int, share: float) -> None:
    """Behind the head, which goes on saying that it gives what it was set to."""
    watts = twin.watts
    twin.watts = lambda k, time_s: (share if k == laser else 1.0) * watts(k, time_s)


@pytest.mark.parametrize(
    ("share", "says"),
    [
        (0.75, r"since image 5: laser power of view 0, spot 1, laser 1: 2\.\d+ mW, was 3\.\d+ mW \(allowed: 20 %\)"),
        (1.3, r"since image 5: laser power of view 0, spot 1, laser 1: 5\.\d+ mW, was 3\.\d+ mW \(allowed: 20 %\)"),
        (0.05, r"laser 532 nm gives 0\.\d+ mW .* at the photodiode instead of 10 mW.*Remedy"),
        (0.9, None),
    ],
)
def test_a_dim_laser_among_bright_ones_is_compared_by_its_power(
    tmp_path: Path, share: float, says: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    """Rationale: its images cannot tell that its fibre or gate has failed, and the other lasers' look right."""
    parts = tmp_path / "parts"
    with pytest.raises(RuntimeError, match="out of light"):
        capture(Emulation(TwinRig(RIG, Absorbed(1, fail_at=9), seed=5)).serial_rig(), PLAN, parts)
    before = contents(parts)
    twin = TwinRig(RIG, Absorbed(1), seed=5)
    emulation = Emulation(twin)
    weaker(twin, 1, share)
    if says is None:
        capture(emulation.serial_rig(), PLAN, parts, sensor=SENSOR)
        assert "no stored spot of laser 1 is bright enough to compare images: laser power of view" in caplog.text
        return
    with pytest.raises(DiscoError, match=says):
        capture(emulation.serial_rig(), PLAN, parts, sensor=SENSOR)
    assert contents(parts) == before
    assert emulation.bench.light() == [] and emulation.bench.hazards == []


def test_resuming_with_a_dim_laser_gives_the_same_bytes(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    capture(TwinRig(RIG, Absorbed(1), seed=5), PLAN, whole)
    with pytest.raises(RuntimeError, match="out of light"):
        capture(Emulation(TwinRig(RIG, Absorbed(1, fail_at=9), seed=5)).serial_rig(), PLAN, parts)
    capture(Emulation(TwinRig(RIG, Absorbed(1), seed=5)).serial_rig(), PLAN, parts, sensor=SENSOR)
    assert contents(parts) == contents(whole)
