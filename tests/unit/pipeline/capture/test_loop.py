"""The capture loop: order, safety, interruption; and a process that is killed at any moment."""

from __future__ import annotations

import os
import random
import shutil
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from capture_fakes import FakeRig, contents, fork, small_plan

from hw.base.errors import DiscoError, InputError
from hw.record import RawImage
from pipeline.capture.loop import Interrupted, capture
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.stream.layout import ImageMeta
from pipeline.stream.stream import SYNC_EVERY, CorruptImage, StreamReader, StreamWriter

PLAN = small_plan()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted capture. Not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    capture(FakeRig(PLAN), PLAN, folder)
    return folder


def test_captures_everything_in_order_and_reports(tmp_path: Path) -> None:
    rig, seen = FakeRig(PLAN), []
    assert capture(rig, PLAN, tmp_path, lambda done, total: seen.append((done, total))) == 0
    assert seen == [(i + 1, len(PLAN)) for i in range(len(PLAN))]
    assert rig.exposures == 48
    assert rig.dark
    assert not rig.powered
    with StreamReader(tmp_path) as stream:
        times = [stream.meta(i).time_s for i in range(48)]
        assert times == sorted(times)
        for i, address in enumerate(PLAN.addresses()):
            meta = stream.meta(i)
            assert meta.angle_rad == PLAN.angles_rad[PLAN.angle_of(address.view)]
            if address.kind == "spot":
                aim = PLAN.spots[address.spot]
                assert (meta.u, meta.v) == (aim.u, aim.v)
                assert meta.photodiode_w == pytest.approx(0.01 * (address.laser + 1), rel=0.11)  # the fake's drift
            else:
                assert (meta.u, meta.v, meta.photodiode_w) == (-1, -1, 0.0)


def test_every_view_announces_its_spots_once_and_before_they_are_lit(tmp_path: Path) -> None:
    rig = FakeRig(PLAN)

    def announced_before_lit(rig: FakeRig) -> None:
        assert rig.flood or rig.mirrors in {(aim.u, aim.v) for aim in rig.announced[-1]}

    rig.on_expose = announced_before_lit
    capture(rig, PLAN, tmp_path)
    expected = [PLAN.spots[:3], PLAN.spots[3:]] * 2  # the middle angle has no spot
    assert rig.announced == expected


def test_a_finished_capture_does_not_switch_the_rig_on(tmp_path: Path, finished: Path) -> None:
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    rig = FakeRig(PLAN)
    assert capture(rig, PLAN, tmp_path) == 48
    assert rig.exposures == 0
    assert contents(tmp_path) == contents(finished)


def after(exposures: int, action: Callable[[FakeRig], None]) -> Callable[[FakeRig], None]:
    """Do something just before an exposure."""
    return lambda rig: action(rig) if rig.exposures == exposures else None


def raise_error(rig: FakeRig) -> None:
    raise RuntimeError("the camera fell off")


@pytest.mark.parametrize("at", range(48))
def test_any_failure_leaves_the_rig_safe_and_resuming_gives_the_same_bytes(
    tmp_path: Path, finished: Path, at: int
) -> None:
    """An exception at every single image: the clock, the mirrors and the turntable are restored from what is stored."""
    rig = FakeRig(PLAN, on_expose=after(at, raise_error))
    with pytest.raises(RuntimeError, match="fell off"):
        capture(rig, PLAN, tmp_path)
    assert rig.dark
    assert not rig.powered
    assert rig.made_safe
    assert capture(FakeRig(PLAN), PLAN, tmp_path) == at
    assert contents(tmp_path) == contents(finished)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("at", [0, 1, 20, 47])
def test_a_signal_stops_at_once(tmp_path: Path, finished: Path, number: signal.Signals, at: int) -> None:
    """Lasers go out before the image is finished: it is dropped and taken again; handlers are put back."""

    def interrupted(rig: FakeRig) -> None:
        os.kill(os.getpid(), number)
        pytest.fail("went on")

    before = signal.getsignal(number)
    rig = FakeRig(PLAN, on_expose=after(at, interrupted))
    with pytest.raises(Interrupted, match=f"stopped: {at} of 48 images are stored") as caught:
        capture(rig, PLAN, tmp_path)
    assert isinstance(caught.value, DiscoError)
    assert signal.getsignal(number) is before
    assert rig.dark
    assert rig.made_safe
    capture(FakeRig(PLAN), PLAN, tmp_path)
    assert contents(tmp_path) == contents(finished)


def test_a_signal_while_an_image_is_stored_waits_for_that(
    tmp_path: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = StreamWriter.append

    def interrupted(self: StreamWriter, address: ImageAddress, raw: RawImage, meta: ImageMeta) -> None:
        if len(self) == 5:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        append(self, address, raw, meta)

    monkeypatch.setattr(StreamWriter, "append", interrupted)
    rig = FakeRig(PLAN)
    with pytest.raises(Interrupted, match="stopped: 6 of 48"):
        capture(rig, PLAN, tmp_path)
    assert rig.dark and rig.made_safe
    capture(FakeRig(PLAN), PLAN, tmp_path)
    assert contents(tmp_path) == contents(finished)


def test_a_second_signal_does_not_stop_the_rig_from_becoming_safe(tmp_path: Path) -> None:
    class Rig(FakeRig):
        def make_safe(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            super().make_safe()

    rig = Rig(PLAN, on_expose=after(5, lambda _: os.kill(os.getpid(), signal.SIGINT)))
    with pytest.raises(Interrupted, match="stopped: 5 of 48"):
        capture(rig, PLAN, tmp_path)
    assert rig.dark and rig.made_safe == 2


def test_a_signal_while_the_rig_works_ahead_is_obeyed_at_once(tmp_path: Path) -> None:
    class Slow(FakeRig):
        def announce(self, aims: object) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            pytest.fail("went on")

    with pytest.raises(Interrupted, match="stopped: 1 of 48"):
        capture(Slow(PLAN), PLAN, tmp_path)


class Lost:
    """A signal at the moment in which Python swallows what is raised."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


def lost(*_: object) -> None:
    Lost()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(("moment", "images"), [("exposure", 6), ("announcement", 1), ("restoring", 6)])
def test_a_signal_that_python_lost_still_stops_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str, images: int
) -> None:
    """Expected: after the image in progress, and before another thing moves or is lit; not deaf till the end."""
    rig = FakeRig(PLAN)
    if moment == "exposure":
        rig.on_expose = after(5, lost)
    elif moment == "announcement":
        monkeypatch.setattr(rig, "announce", lost)
    else:
        with pytest.raises(RuntimeError):
            capture(FakeRig(PLAN, on_expose=after(6, raise_error)), PLAN, tmp_path)
        monkeypatch.setattr(rig.turntable, "move", lambda angle: pytest.fail("moved"))
        monkeypatch.setattr(StreamWriter, "last_meta", lambda self: (lost(), last_meta(self))[1])
    with pytest.raises(Interrupted, match=f"stopped: {images} of 48"):
        capture(rig, PLAN, tmp_path)
    assert rig.dark and rig.made_safe and rig.exposures == {"exposure": 6, "announcement": 1, "restoring": 0}[moment]


last_meta = StreamWriter.last_meta


def test_a_device_that_fails_on_the_way_out_does_not_hide_the_signal(tmp_path: Path) -> None:
    """The supervisor closes the ports at the signal, and then nobody can talk to the laser any more."""

    class Supervised(FakeRig):
        def __enter__(self) -> Supervised:
            super().__enter__()
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            finally:
                raise DiscoError("the laser's port is closed")

    with pytest.raises(Interrupted, match="stopped: 0 of 48"):
        capture(Supervised(PLAN), PLAN, tmp_path)
    with pytest.raises(DiscoError, match="port is closed"):
        capture(FakeRig(PLAN, on_expose=after(3, closed_port)), PLAN, tmp_path)


def closed_port(rig: FakeRig) -> None:
    raise DiscoError("the laser's port is closed")


def test_signals_that_are_ignored_stay_ignored(tmp_path: Path) -> None:
    """nohup: the terminal's end does not end the capture."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        capture(FakeRig(PLAN, on_expose=after(3, lambda _: os.kill(os.getpid(), signal.SIGHUP))), PLAN, tmp_path)
    finally:
        signal.signal(signal.SIGHUP, before)
    with StreamReader(tmp_path) as stream:
        assert stream.complete


def test_a_signal_while_the_rig_is_made_safe_does_not_stop_that(tmp_path: Path) -> None:
    class Rig(FakeRig):
        def make_safe(self) -> None:
            if self.made_safe:  # the loop's own call, after the rig's __exit__
                os.kill(os.getpid(), signal.SIGINT)
            super().make_safe()

    rig = Rig(PLAN)
    capture(rig, PLAN, tmp_path)
    assert rig.made_safe == 2


def test_works_outside_the_main_thread(tmp_path: Path, finished: Path) -> None:
    thread = threading.Thread(target=capture, args=(FakeRig(PLAN), PLAN, tmp_path))
    thread.start()
    thread.join(60)
    assert contents(tmp_path) == contents(finished)


def test_a_rig_that_cannot_be_switched_on_is_made_safe(tmp_path: Path) -> None:
    class Broken(FakeRig):
        def __enter__(self) -> Broken:
            self.open = 1
            raise DiscoError("laser 2 does not answer")

    rig = Broken(PLAN)
    with pytest.raises(DiscoError, match="does not answer"):
        capture(rig, PLAN, tmp_path)
    assert rig.dark
    assert rig.made_safe == 1


def test_a_gate_that_fails_half_way_is_shut(tmp_path: Path) -> None:
    rig = FakeRig(PLAN)
    shut: list[int] = []

    def half_open() -> None:
        rig.open = 0
        raise DiscoError("no acknowledgement")

    rig.lasers[0].open_gate = half_open  # type: ignore[method-assign]
    rig.lasers[0].close_gate = lambda: shut.append(rig.made_safe)  # type: ignore[method-assign]
    with pytest.raises(DiscoError, match="no acknowledgement"):
        capture(rig, PLAN, tmp_path)
    assert shut == [0]  # at once, not only when the rig is made safe


@pytest.mark.parametrize(
    ("plan", "says"),
    [
        (Plan(("other", "camera1"), PLAN.angles_rad, PLAN.spots, 3), "other cameras"),
        (Plan(PLAN.cameras, PLAN.angles_rad, PLAN.spots, 2), "other lasers"),
    ],
)
def test_a_plan_for_another_rig_is_refused(tmp_path: Path, plan: Plan, says: str) -> None:
    with pytest.raises(InputError, match=says):
        capture(FakeRig(PLAN), plan, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_folder_of_another_plan_is_refused_before_the_rig_is_on(tmp_path: Path, finished: Path) -> None:
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    other = small_plan((1, 1, 1))
    rig = FakeRig(other)
    with pytest.raises(InputError, match="another plan"):
        capture(rig, other, tmp_path)
    assert rig.made_safe == 0
    assert contents(tmp_path) == contents(finished)


# --- SIGKILL ---------------------------------------------------------------------------------------------------------

LONG = small_plan((200, 125, 150))
KILLS = 200


def _child(folder: Path, report: int, credit: int, budget: int | None) -> None:
    """Captures, and tells of every stored image; runs at most three images ahead of the one who listens.

    With a budget, the process kills itself in the middle of the write that reaches so many bytes.
    """
    real, left = os.pwrite, budget

    def pwrite(file: int, data: bytes, offset: int) -> int:
        nonlocal left
        if left is not None and left <= len(data):
            real(file, data[:left], offset)
            os.kill(os.getpid(), signal.SIGKILL)
        left = None if left is None else left - len(data)
        return real(file, data, offset)

    def tell(done: int, total: int) -> None:
        os.write(report, b"%d\n" % done)
        os.read(credit, 1)

    os.pwrite = pwrite
    capture(FakeRig(LONG), LONG, folder, tell)


def _capture_and_kill(folder: Path, budget: int | None, kill_at: int) -> tuple[int, bool]:
    """(last image that the child reported as stored, whether it was killed)."""
    read, report = os.pipe()
    credit, grant = os.pipe()
    child = fork(_child, folder, report, credit, budget)
    os.close(report)
    os.write(grant, b"...")
    last = 0
    with os.fdopen(read) as lines:
        for line in lines:
            last = int(line)
            if budget is None and last == kill_at and child.pid is not None:
                os.kill(child.pid, signal.SIGKILL)
            os.write(grant, b".")
    child.join(60)
    os.close(credit)
    os.close(grant)
    return last, child.exitcode == -signal.SIGKILL


@pytest.mark.parametrize("how", ["at a byte", "from outside"])
def test_sigkill_at_200_moments_loses_nothing_that_was_reported(tmp_path: Path, how: str) -> None:
    """Kill, look, resume, kill again ...: what was reported is there and whole, the end equals an undisturbed capture.

    "at a byte": in the middle of a write, at random bytes of entries, payloads and journal, on their boundaries too.
    "from outside": wherever the process happens to be.
    """
    choose = random.Random(11)
    whole, folder = tmp_path / "whole", tmp_path / "killed"
    capture(FakeRig(LONG), LONG, whole)
    size = sum(len(data) for name, data in contents(whole).items() if name != "plan.json")
    kills = stored = 0
    for _ in range(KILLS):
        bytes_left = choose.choice(
            [1, 63, 64, 65, 128, 129, *(choose.randint(1, size * 5 // (3 * KILLS)) for _ in range(6))]
        )
        budget = bytes_left if how == "at a byte" else None
        last, killed = _capture_and_kill(folder, budget, stored + choose.randint(1, len(LONG) * 4 // (5 * KILLS)))
        kills += killed
        if (folder / "plan.json").exists() and (folder / "journal.bin").exists() and max(last, stored):
            with StreamReader(folder) as stream:
                assert len(stream) >= max(last, stored)
                recent = range(max(stored - SYNC_EVERY, 0), len(stream))  # opening to write drops no earlier ones
                assert not any(isinstance(image, CorruptImage) for image in stream.read_many(recent))
                stored = len(stream)
    assert kills == KILLS
    assert 0 < stored < len(LONG)
    assert capture(FakeRig(LONG), LONG, folder) == stored
    assert contents(folder) == contents(whole)


def test_an_image_is_stored_while_the_next_one_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Encoding takes half a frame. Expected: what is stored late keeps no exposure waiting, and its order."""
    append, begun = StreamWriter.append, [threading.Event() for _ in range(len(PLAN))]

    def late(self: StreamWriter, address: ImageAddress, raw: RawImage, meta: ImageMeta) -> None:
        assert begun[min(len(self) + 1, len(PLAN) - 1)].wait(5.0)
        append(self, address, raw, meta)

    monkeypatch.setattr(StreamWriter, "append", late)
    monkeypatch.setattr("pipeline.capture.loop.SMALL", 0)
    assert capture(FakeRig(PLAN, lambda rig: begun[rig.exposures].set()), PLAN, tmp_path) == 0
    with StreamReader(tmp_path) as stream:
        stream.require_complete()


def test_large_images_are_stored_as_small_ones_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the background: reported in order when they are stored, all of them after Ctrl-C, and bit for bit the same."""
    capture(FakeRig(PLAN), PLAN, tmp_path / "small")
    monkeypatch.setattr("pipeline.capture.loop.SMALL", 0)
    seen: list[int] = []

    def interrupt(rig: FakeRig) -> None:
        if rig.exposures == 7:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match="7 of 48"):
        capture(FakeRig(PLAN, interrupt), PLAN, tmp_path / "large", lambda done, total: seen.append(done))
    assert capture(FakeRig(PLAN), PLAN, tmp_path / "large", lambda done, total: seen.append(done)) == 7
    assert seen == list(range(1, 49)) and contents(tmp_path / "large") == contents(tmp_path / "small")
