"""The twin behind the interface: safety, determinism, clock, faults, deviation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.camera.lens import vignetting
from disco_twin.emulation.twin_rig import TURN_S, TwinRig
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.faults.light_faults import MODE_HOP_S, SPECKLE_CONTRAST, LaserPower, Stream, generator, speckle
from disco_twin.scene.rig_schema import FaultsConfig, TwinRigConfig
from hw.base.errors import DiscoError, InputError, Refused
from hw.interface import Aim, Rig
from hw.record import RawImage, to_radiance
from pipeline.capture.loop import capture
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan

F32 = NDArray[np.float32]


class Lamp:
    """A fake light source: a smooth blob per watt, brighter for higher u; remembers what it was told."""

    def __init__(self, value: float = 1e-3) -> None:
        self.value, self.prepared = value, list[Aim]()

    def prepare(self, aims: Sequence[Aim]) -> None:
        self.prepared += aims

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        return np.full((16, 24), self.value * (1 + aim.u / 4095) * (laser + 1), np.float32)

    def silhouette(self, camera: int, angle: int) -> F32:
        return np.full((16, 24), 1e-5, np.float32)


def config(**faults: bool) -> TwinRigConfig:
    """Two cameras, three angles, three lasers."""
    cameras = (
        CameraConfig(name="front", position_mm=(450, 0, 100), width=24, height=16),
        CameraConfig(name="back", position_mm=(-450, 0, 100), width=24, height=16),
    )
    return TwinRigConfig(cameras=cameras, turntable_angles_deg=(0, 120, 240), faults=FaultsConfig(**faults))


SENSOR = lars3_sensor(config())


def spot(rig: Rig, camera: int, angle: int, u: int, v: int, laser: int) -> tuple[RawImage, float]:
    """One spot image with the photodiode's reading."""
    rig.turntable.move(np.deg2rad(120.0 * angle))
    rig.projector.move(u, v)
    rig.lasers[laser].open_gate()
    raw = rig.cameras[camera].expose()
    watts = rig.photodiode.read()
    rig.lasers[laser].close_gate()
    return raw, watts


def same(a: RawImage, b: RawImage) -> bool:
    return bool((a.charge == b.charge).all() and (a.exponent == b.exponent).all())


def test_an_image_does_not_depend_on_what_was_taken_before() -> None:
    addresses = [(c, j, u, 7, w) for c in (0, 1) for j in (0, 2) for u in (5, 6) for w in (0, 1, 2)]
    with TwinRig(config(), Lamp(), 3) as rig:
        forward = {a: spot(rig, *a) for a in addresses}
    with TwinRig(config(), Lamp(), 3) as rig:
        for a in reversed(addresses):
            raw, watts = spot(rig, *a)
            assert same(raw, forward[a][0])
            assert watts == forward[a][1]
    images = [forward[a][0].charge.tobytes() for a in addresses]
    assert len(set(images)) == len(images)
    with TwinRig(config(), Lamp(), 4) as rig:
        assert not same(spot(rig, *addresses[0])[0], forward[addresses[0]][0])


def test_repeated_exposures_have_their_own_noise() -> None:
    with TwinRig(config(), Lamp(), 0) as rig:
        a, b = rig.cameras[0].expose(), rig.cameras[0].expose()
        assert not same(a, b)
    with rig:
        assert same(rig.cameras[0].expose(), a)


def test_resumed_rig_meets_the_same_times_and_noise() -> None:
    """Stop after any image, restart, go back to it: times, readings and images are as without a stop."""
    order = [(0, 0, 9, 7, w) for w in range(3)] + [(0, 1, 9, 7, w) for w in range(3)]
    rig = TwinRig(config(blue_noise=True, warm_up=True), Lamp(), 1)

    def sweep(start: int, when: float) -> list[tuple[RawImage, float, float]]:
        out = []
        with rig:
            if start:
                rig.turntable.move(np.deg2rad(120.0 * order[start - 1][1]))
            rig.resume_at(when)
            for i, a in enumerate(order[start:], start):
                if i % 3 == 0:
                    rig.turntable.move(np.deg2rad(120.0 * a[1]))
                    rig.floodlight.on()
                    rig.cameras[0].expose()
                    rig.floodlight.off()
                out.append((*spot(rig, *a), rig.now()))
        return out

    whole = sweep(0, 0.0)
    for start in range(1, len(order)):
        for (raw, watts, time), (raw2, watts2, time2) in zip(
            whole[start:], sweep(start, whole[start - 1][2]), strict=True
        ):
            assert same(raw, raw2)
            assert (watts, time) == (watts2, time2)


def test_fifteen_images_a_second() -> None:
    with TwinRig(config(), Lamp(), 0) as rig:
        for i in range(30):
            spot(rig, 0, 0, i, 0, i % 3)
        assert rig.now() == pytest.approx(2.0)
        rig.turntable.move(0.0)
        assert rig.now() == pytest.approx(2.0)
        rig.turntable.move(np.deg2rad(240))
        assert rig.now() == pytest.approx(2.0 + TURN_S)


def test_radiance_comes_back() -> None:
    """Laser power x response, seen through the lens and the sensor, is what the record says."""
    with TwinRig(config(), Lamp(), 0) as rig:
        raw, watts = spot(rig, 0, 0, 0, 0, 1)
    gain = vignetting(PinholeCamera.from_config(config().cameras[0]))
    image = to_radiance(raw, SENSOR, 1)
    z = (image.radiance / gain - 2e-3 * 0.010) / np.sqrt(image.variance)
    assert watts == pytest.approx(0.010, rel=0.005)
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert z.std() == pytest.approx(1, abs=4 / np.sqrt(2 * z.size))


def test_no_light_without_gate_or_floodlight() -> None:
    with TwinRig(config(), Lamp(), 0) as rig:
        dark = rig.cameras[0].expose()
        assert rig.photodiode.read() == 0
        assert dark.charge.max() < 75
        rig.floodlight.on()
        assert rig.cameras[0].expose().charge.mean() > 200
        rig.floodlight.off()
        assert rig.cameras[0].expose().charge.max() < 75


def test_one_gate_at_a_time_and_none_during_moves() -> None:
    with TwinRig(config(), Lamp(), 0) as rig:
        rig.lasers[0].open_gate()
        rig.lasers[0].open_gate()  # open already: nothing to refuse
        with pytest.raises(Refused, match="one laser at a time"):
            rig.lasers[1].open_gate()
        with pytest.raises(Refused, match="projector must not move"):
            rig.projector.move(1, 1)
        with pytest.raises(Refused, match="turntable must not move"):
            rig.turntable.move(0.0)
        rig.lasers[1].close_gate()  # shutting another gate leaves this one open
        with pytest.raises(Refused):
            rig.projector.move(1, 1)
        rig.lasers[0].close_gate()
        rig.projector.move(1, 1)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_leaving_the_rig_for_any_reason_makes_it_safe(error: type[BaseException]) -> None:
    rig = TwinRig(config(), Lamp(), 0)

    def work() -> None:
        with rig:
            rig.lasers[2].open_gate()
            rig.floodlight.on()
            raise error

    with pytest.raises(error):
        work()
    assert rig.scene.gate == -1
    assert not rig.scene.flood
    rig.make_safe()
    for forbidden in (rig.lasers[0].open_gate, rig.cameras[0].expose, rig.floodlight.on, rig.photodiode.read):
        with pytest.raises(Refused, match="switched off"):
            forbidden()


def test_bad_orders_are_refused_in_one_line() -> None:
    with TwinRig(config(), Lamp(), 0) as rig:
        for u, v in ((-1, 0), (0, 4096)):
            with pytest.raises(InputError, match="allowed: 0 to 4095"):
                rig.projector.move(u, v)
        for angle in (0.5, float("nan")):
            with pytest.raises(InputError, match=r"no light for this turntable angle.*0, 120, 240"):
                rig.turntable.move(angle)
        rig.turntable.move(np.deg2rad(-120))  # the same as 240
        assert rig.scene.angle == 2


@pytest.mark.parametrize("value", [-1e-3, float("nan"), float("inf")])
def test_impossible_light_is_reported(value: float) -> None:
    with TwinRig(config(), Lamp(value), 0) as rig, pytest.raises(DiscoError, match=r"camera front .* not finite"):
        spot(rig, 0, 0, 0, 0, 0)


def test_announced_spots_reach_the_source() -> None:
    lamp = Lamp()
    with TwinRig(config(), lamp, 0) as rig:
        rig.announce([Aim(0, 1, 2)])
    assert lamp.prepared == [Aim(0, 1, 2)]


def test_power_is_constant_without_faults() -> None:
    power = LaserPower(config().lasers, FaultsConfig(), 0)
    assert {power.watts(laser, t) for laser in range(3) for t in (0, 1.0, 260.0)} == {0.01}


def test_laser_faults_follow_figure_4_6() -> None:
    red, green, blue = range(3)
    lasers = config().lasers
    warm = LaserPower(lasers, FaultsConfig(warm_up=True), 0)
    assert warm.watts(red, 0) < warm.watts(red, 20) < warm.watts(red, 60) < 0.01
    assert warm.watts(red, 60) > 0.98 * 0.01
    assert warm.watts(blue, 0) < 0.5 * 0.01
    assert warm.watts(blue, 15) > 0.99 * 0.01
    hop = LaserPower(lasers, FaultsConfig(mode_hop=True), 0)
    assert hop.watts(green, MODE_HOP_S - 0.1) == 0.01
    assert hop.watts(green, MODE_HOP_S + 0.1) == pytest.approx(0.0106)
    assert hop.watts(red, 300) == hop.watts(blue, 300) == 0.01
    noisy = LaserPower(lasers, FaultsConfig(blue_noise=True), 0)
    values = np.array([noisy.watts(blue, t) for t in np.arange(0, 600, 1.37)])
    assert values.mean() == pytest.approx(0.01, rel=0.01)
    assert values.std() == pytest.approx(0.0003, rel=0.25)
    assert noisy.watts(red, 3) == 0.01
    other = LaserPower(lasers, FaultsConfig(blue_noise=True), 1)
    assert other.watts(blue, 3) != noisy.watts(blue, 3)


def test_photodiode_follows_the_power_that_the_camera_sees() -> None:
    with TwinRig(config(warm_up=True), Lamp(), 0) as rig:
        first, watts = spot(rig, 0, 0, 0, 0, 2)
        rig.resume_at(600.0)
        late, watts_late = spot(rig, 0, 0, 0, 0, 2)
    ratio = to_radiance(first, SENSOR, 2).radiance.mean() / to_radiance(late, SENSOR, 2).radiance.mean()
    assert watts < 0.5 * watts_late
    assert ratio == pytest.approx(watts / watts_late, rel=0.01)


def test_speckle_has_mean_one_and_its_contrast() -> None:
    pattern = speckle((400, 400), np.random.default_rng(0))
    assert abs(pattern.mean(dtype=float) - 1) < 4 * SPECKLE_CONTRAST / 400
    assert pattern.std(dtype=float) == pytest.approx(SPECKLE_CONTRAST, rel=0.01)
    with TwinRig(config(speckle=True), Lamp(1e-2), 0) as rig:
        rig.lasers[0].open_gate()
        a, b = rig.cameras[0].expose(), rig.cameras[0].expose()
    a_values, b_values = (to_radiance(x, SENSOR, 0).radiance for x in (a, b))
    assert np.corrcoef(a_values.ravel(), b_values.ravel())[0, 1] > 0.9  # it stands still, unlike noise


def test_flare_brightens_the_dark() -> None:
    class Point(Lamp):
        def image(self, camera: int, aim: Aim, laser: int) -> F32:
            out = np.zeros((16, 24), np.float32)
            out[8, 12] = 1e-2
            return out

    means = []
    for flare in (False, True):
        with TwinRig(config(flare=flare), Point(), 0) as rig:
            means.append(spot(rig, 0, 0, 0, 0, 0)[0].charge[:4].mean())
    assert means[1] > means[0] + 1


def test_actual_rig_is_the_nominal_one_unless_it_deviates() -> None:
    rig = actual_rig(config(), 5)
    aims = [Aim(0, 100, 4000), Aim(2, 2000, 50)]
    origins, directions = rig.spot_rays(aims)
    for i, aim in enumerate(aims):
        nominal = rig.projector.seen_from(turn(np.deg2rad(120.0 * aim.angle))).rays(np.array([[aim.u, aim.v]]))
        assert np.allclose(origins[i], nominal[0][0])
        assert np.allclose(directions[i], nominal[1][0])
    world = rig.cameras[1].project(np.array([[1.0, 2.0, 3.0]]) @ turn(np.deg2rad(120))[:3, :3].T)[0]
    assert np.allclose(rig.camera(1, 1).project(np.array([[1.0, 2.0, 3.0]]))[0], world)


def test_deviation_is_seeded_small_and_everywhere() -> None:
    nominal, a, b = (
        actual_rig(config(), 1),
        actual_rig(config(deviation=True), 1),
        actual_rig(config(deviation=True), 1),
    )
    c = actual_rig(config(deviation=True), 2)
    aims = [Aim(j, u, v) for j in range(3) for u in (1000, 3000) for v in (1000, 3000)]
    assert np.array_equal(a.spot_rays(aims)[0], b.spot_rays(aims)[0])
    assert np.array_equal(a.spot_rays(aims[::-1])[0], b.spot_rays(aims)[0][::-1])
    assert not np.allclose(a.spot_rays(aims)[0], c.spot_rays(aims)[0])
    points = np.random.default_rng(0).uniform(-20, 20, (50, 3))
    for camera in range(2):
        for angle in range(3):
            away = a.camera(camera, angle).project(points)[0] - nominal.camera(camera, angle).project(points)[0]
            assert 0.1 < np.linalg.norm(away, axis=1).mean() < 30  # pixels
    for at, ideal in zip(a.turns, nominal.turns, strict=True):
        assert np.allclose(at[:3, :3] @ at[:3, :3].T, np.eye(3))
        assert 0 < np.abs(at - ideal).max() < 1
    steps = np.array([a.steps(aim) - [aim.u, aim.v] for aim in [Aim(0, u, 7) for u in range(500)]])
    assert steps.std() == pytest.approx(0.5, rel=4 / np.sqrt(2000))


def test_streams_of_random_numbers_do_not_meet() -> None:
    first = {float(generator(seed, s, i).random()) for seed in (0, 1) for s in Stream for i in range(20)}
    assert len(first) == 2 * len(Stream) * 20


def test_the_pipelines_loop_captures_resumes_and_reads_back(tmp_path: Path) -> None:
    """The real loop over the twin, stopped half-way: the same stream, byte for byte, as in one go."""
    rig_config = config(warm_up=True, blue_noise=True, speckle=True, deviation=True)
    spots = tuple(Aim(j, 100 * i + 5, 300 * j + i) for j in range(3) for i in range(4))
    angles = tuple(np.deg2rad(a) for a in rig_config.turntable_angles_deg)
    plan = Plan(("front", "back"), angles, spots, 3)
    capture(TwinRig(rig_config, Lamp(), 7), plan, tmp_path / "whole")

    def stop(done: int, total: int) -> None:
        if done in (1, 14, 30):
            raise KeyboardInterrupt

    for _ in range(3):
        with pytest.raises(DiscoError):
            capture(TwinRig(rig_config, Lamp(), 7), plan, tmp_path / "parts", stop)
    capture(TwinRig(rig_config, Lamp(), 7), plan, tmp_path / "parts", None)
    files = sorted(p.relative_to(tmp_path / "whole") for p in (tmp_path / "whole").rglob("*") if p.is_file())
    assert files
    for name in files:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()
