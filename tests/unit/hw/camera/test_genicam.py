"""The bracketed camera: against exact sensors, a grabber with every fault, and two GigE Vision cameras not ours."""

from __future__ import annotations

import ctypes
import fcntl
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import aravis_camera
import numpy as np
import pytest
from numpy.typing import NDArray

from hw.base.errors import InputError
from hw.camera.bracket import Bracket
from hw.camera.genicam import ATTEMPTS, CameraError, CameraFrame, FrameLost, GenicamCamera
from hw.record import Sensor, to_radiance

SIZE = (496, 768)
ALL = tuple(range(12))
BRACKET = Bracket(0.02048, ALL, 12, 4000)


def sensor(bracket: Bracket, gain: float = 8.0) -> Sensor:
    return Sensor(bracket.longest_exposure_s, max(bracket.exponents) + 1, bracket.bits, gain, 5.0, 0.0, 64.0, (1e12,))


def exposure(rate: NDArray[np.float64], seconds: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """A linear 12-bit sensor of 8 e/DN: electrons per second -> digital numbers."""
    dn = rng.poisson(rate * seconds) / 8.0 + 64.0 + rng.standard_normal(rate.shape) * 5.0 / 8.0
    return np.clip(np.rint(dn), 0, 4095).astype(np.uint16)


def test_merge_equals_the_longest_unsaturated_exposure_pixel_by_pixel() -> None:
    rng = np.random.default_rng(1)
    bracket = Bracket(0.02048, (0, 2, 5, 6), 12, 4000)
    frames = rng.integers(0, 4096, (4, 20, 30)).astype(np.uint16)
    record = bracket.merge(zip(bracket.exponents, frames, strict=True))
    for row, column in np.ndindex(20, 30):
        series = frames[:, row, column]
        good = next((k for k in range(4) if series[k] < 4000), None)
        got = (record.exponent[row, column], record.charge[row, column])
        assert got == ((6, 4095) if good is None else (bracket.exponents[good], series[good]))


def test_merge_asks_for_no_frame_that_it_does_not_need() -> None:
    taken = []

    def frames() -> Iterator[tuple[int, NDArray[np.uint16]]]:
        for k in ALL:
            taken.append(k)
            yield k, np.full((4, 4), 65535 if k < 2 else 900, np.uint16)

    record = Bracket(1.0, ALL, 16, 60000).merge(frames())
    assert taken == [0, 1, 2]
    assert (record.exponent == 2).all() and (record.charge == 900).all()


def test_radiance_of_a_bracket_is_unbiased_over_120_db() -> None:
    """Rationale: photon and read noise of 2000 brackets a level, and the choice of the exposure by its own outcome.

    Expected: |z| < 4 where no exposure ends within 4 sigma of the saturation level; elsewhere at most .4 % too low, as
    the module says; the noise as predicted.
    """
    rng, z, near = np.random.default_rng(2), [], []
    for rate in 10.0 ** np.linspace(4, 9.3, 64):
        rates = np.full((1, 2000), rate)
        raw = BRACKET.merge((k, exposure(rates, BRACKET.exposure_s(k), rng)) for k in ALL)
        image = to_radiance(raw, sensor(BRACKET), 0)
        assert not image.saturated.any()
        spread, mean = float(image.radiance.std(ddof=1)), float(image.radiance.astype(float).mean())
        error = mean / (rate / 1e12) - 1
        levels = np.array([rate * BRACKET.exposure_s(k) / 8.0 + 64 for k in ALL])
        if np.abs(levels - 4000).min() < 4 * np.sqrt(4000 / 8.0):
            near.append(error)
            continue
        assert spread == pytest.approx(float(np.sqrt(image.variance.mean())), rel=0.15)
        z.append(error * rate / 1e12 / (spread / np.sqrt(rates.size)))
    assert len(z) > 40 and np.abs(z).max() < 4
    assert 0.5 < np.std(z) < 1.5
    assert len(near) >= 3 and min(near) > -0.004 and max(near) < 0.001


def test_a_pixel_that_is_saturated_in_every_exposure_says_so() -> None:
    raw = BRACKET.merge((k, np.full((2, 2), 4010, np.uint16)) for k in ALL)
    assert to_radiance(raw, sensor(BRACKET), 0).saturated.all()


@pytest.mark.parametrize(("exponents", "saturation"), [((), 4000), ((1, 2), 4000), ((0, 2, 1), 4000), ((0,), 4096)])
def test_impossible_brackets_are_refused(exponents: tuple[int, ...], saturation: int) -> None:
    with pytest.raises(InputError):
        Bracket(0.02, exponents, 12, saturation)


@dataclass
class Fake:
    """A grabber of a linear ramp; `faults` maps the number of a trigger to what goes wrong there."""

    faults: dict[int, object] = field(default_factory=dict)
    step_us: float = 0.01
    made: float = 0.0
    triggers: int = 0
    restarts: int = 0

    def identity(self) -> str:
        return "fake"

    def set_exposure(self, seconds: float) -> float:
        self.made = round(seconds * 1e6 / self.step_us) * self.step_us * 1e-6
        return self.made

    def grab(self, timeout_s: float) -> CameraFrame:
        assert timeout_s > self.made
        self.triggers += 1
        fault = self.faults.get(self.triggers)
        if isinstance(fault, Exception):
            raise fault
        ramp = np.minimum(4095, 64 + self.made * 1e6 * np.linspace(0, 5, 60)).astype(np.uint16).reshape(6, 10)
        if isinstance(fault, CameraFrame):
            return fault
        return CameraFrame(ramp, self.triggers * 0.1, self.made)

    def restart(self) -> None:
        self.restarts += 1

    def close(self) -> None: ...


def camera(grabber: Fake) -> GenicamCamera:
    return GenicamCamera("front", grabber, BRACKET, (6, 10))


def test_lost_frames_and_frames_of_another_exposure_are_taken_again_and_never_stored() -> None:
    whole = camera(Fake()).expose()
    wrong = CameraFrame(np.full((6, 10), 1, np.uint16), 0.15, 0.005)
    fake = Fake({1: FrameLost("2 packets"), 3: wrong, 4: FrameLost("late")})
    damaged = camera(fake)
    record = damaged.expose()
    assert np.array_equal(record.exponent, whole.exponent) and np.array_equal(record.charge, whole.charge)
    assert (damaged.lost, fake.restarts) == (3, 3)


def test_a_camera_that_keeps_losing_frames_is_given_up_with_the_reason() -> None:
    with pytest.raises(CameraError, match=rf"front: {ATTEMPTS} frames in a row were lost \(7 packets\).*Remedy"):
        camera(Fake(dict.fromkeys(range(1, 99), FrameLost("7 packets")))).expose()


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (CameraFrame(np.zeros((6, 10), np.uint16), 0.05), "its clock went back"),
        (CameraFrame(np.zeros((6, 11), np.uint16), 9.0), "Remedy: width, height"),
        (CameraFrame(np.zeros((6, 10), np.uint8), 9.0), "uint8"),
        (CameraFrame(np.full((6, 10), 4096, np.uint16), 9.0), "above the 4095 of 12 bits"),
    ],
)
def test_frames_that_cannot_be_are_refused(frame: CameraFrame, says: str) -> None:
    with pytest.raises(CameraError, match=says):
        camera(Fake({2: frame})).expose()


def test_a_camera_whose_exposures_are_not_the_bracket_s_is_refused_before_the_capture() -> None:
    with pytest.raises(InputError, match=r"exposes for 20\.00 us instead of 20\.48 us"):
        GenicamCamera("front", Fake(step_us=1.0), Bracket(0.02097152, ALL, 12, 4000), (6, 10)).check()


@pytest.fixture
def gvcp() -> Iterator[int]:
    """GigE Vision has one UDP port: one fake camera per host at a time. The lock, for processes that serve one.

    They hold it for as long as they live: one that outlives a test that was ended from outside still has the port.
    """
    with Path(tempfile.gettempdir(), "disco-gvcp-3956.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield lock.fileno()


@pytest.mark.usefixtures("gvcp")
def test_viva_s_camera_with_changing_exposures_and_a_lost_packet() -> None:
    testing = pytest.importorskip("viva_genicam.testing", reason="needs the extra genicam")
    from hw.camera.viva_grabber import VivaGrabber

    bracket = Bracket(0.02048, (0, 3, 6, 9), 16, 40000)
    with testing.FakeGigeCamera(
        *SIZE[::-1], 60, pixel_format="Mono16", drop_packets=[(2, 5)], packet_resend=False
    ) as device:
        with pytest.raises(InputError, match="is another one"):
            VivaGrabber("127.0.0.1", "Mono16", SIZE, serial="12345")
        grabber = VivaGrabber("127.0.0.1", "Mono16", SIZE, serial="VIVA-FAKE-001")
        cam = GenicamCamera("front", grabber, bracket, SIZE)
        try:
            cam.check()
            raw = cam.expose()
            # Half of the test pattern lies above 40000 in every exposure. It grows by 257 a frame, taken or lost, and
            # a pixel that wraps from 65535 to 0 between two exposures is stored at the second one.
            assert raw.charge.shape == SIZE and {0, 9} <= set(np.unique(raw.exponent)) <= {0, 3, 6, 9}
            assert cam.lost >= 1
            assert np.isin(raw.exponent, (3, 6)).mean() <= 257 * (3 + cam.lost) / 65536 * 2  # and a column's width
            saturated = raw.charge == 65535
            assert (raw.exponent[saturated] == 9).all() and (raw.charge[~saturated] < 40000).all()
            assert device.software_triggers() == 4 + cam.lost
            assert "VIVA-FAKE-001" in grabber.identity()
        finally:
            cam.close()
        assert device.controller() is None  # control was given back


@pytest.mark.usefixtures("gvcp")
def test_twelve_bits_packed_arrive_as_they_are() -> None:
    testing = pytest.importorskip("viva_genicam.testing", reason="needs the extra genicam")
    from hw.camera.viva_grabber import VivaGrabber

    with testing.FakeGigeCamera(*SIZE[::-1], 60, pixel_format="Mono12p"):
        cam = GenicamCamera("front", VivaGrabber("127.0.0.1", "Mono12p", SIZE), Bracket(0.02048, (0,), 12, 4095), SIZE)
        try:
            assert cam.expose().charge.max() == 4095
        finally:
            cam.close()


@pytest.mark.usefixtures("gvcp")
def test_no_camera_is_one_line() -> None:
    pytest.importorskip("viva_genicam", reason="needs the extra genicam")
    from hw.camera.viva_grabber import VivaGrabber

    # What is in reach depends on the network that the machine is in.
    with pytest.raises(CameraError, match=r"camera 127.0.0.9 does not answer; in reach are: .+\. Remedy"):
        VivaGrabber("127.0.0.9", "Mono16", SIZE)


def _aravis() -> bool:
    try:
        ctypes.CDLL(aravis_camera.LIBRARY)
    except OSError:
        return False
    return True


@pytest.mark.skipif(not _aravis(), reason="Debian's aravis-tools are not installed")
def test_aravis_camera_with_our_pixels_through_real_gvsp(gvcp: int) -> None:
    """Rationale: client and camera are by different people, pixels by a formula. Expected: the exact record."""
    pytest.importorskip("viva_genicam", reason="needs the extra genicam")
    from hw.camera.viva_grabber import VivaGrabber

    bracket = Bracket(0.02048, ALL, 12, 4000)
    command = [sys.executable, aravis_camera.__file__, "60"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, pass_fds=[gvcp])
    try:
        assert server.stdout is not None and server.stdout.readline() == "ready\n"
        cam = GenicamCamera("front", VivaGrabber("127.0.0.1", "Mono16", SIZE), bracket, SIZE)
        try:
            cam.check()
            raw = cam.expose()
        finally:
            cam.close()
    finally:
        server.kill()
        server.communicate()
    pixels = SIZE[0] * SIZE[1]
    exact = bracket.merge((k, aravis_camera.expected(pixels, bracket.exposure_s(k) * 1e6)) for k in ALL)
    assert len(np.unique(exact.exponent)) == 12
    assert np.array_equal(raw.exponent.ravel(), exact.exponent)
    assert np.array_equal(raw.charge.ravel(), exact.charge)
