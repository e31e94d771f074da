"""The Omicron driver on a bad line: answers that are lost, late, split, garbled, doubled; a laser that is gone."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from omicron_fakes import emitting
from serial_fakes import LaserBench

from disco_twin.firmware.omicron import LaserHead, OmicronFirmware
from disco_twin.firmware.wire import Fault, after, broken_by, garbled, late, lost, split
from hw.base.errors import DeviceError, Garbled, NoAnswer, Unplugged
from hw.devices.omicron_protocol import Mode

# ---- the line

RECOVERABLE: dict[str, Fault] = {
    "lost": lost,
    "late": late(0.7),
    "very late": late(3.0),
    "split": split(3),
    "split slowly": split(5, 0.3),
    "split too slowly": split(5, 0.7),
    "nuls": after(b"\0\0\0"),
    "garbage before": after(b"\x93\xfe\x07"),
    "two in one read": after(b"!GWH123\r"),
    "message before": after(b"$TPDd25.1\r"),
    "message in it": broken_by(b"$TPDd25.1\r", 3),
    "garbled letters": garbled(2),
    "garbled mark": garbled(0),
    "garbled end": garbled(-1),
}


@pytest.mark.parametrize("name", RECOVERABLE)
@pytest.mark.parametrize("place", range(8))
def test_reading_and_setting_survive_a_bad_line(name: str, place: int) -> None:
    """One bad answer, anywhere in connecting and arming: the laser ends in the state that was asked for."""
    bench = LaserBench()
    bench.line.answer_faults.extend([None] * place + [RECOVERABLE[name]])
    laser = emitting(bench)
    assert laser.measured_mw() == pytest.approx(40.0)
    assert laser.ask("GSN") == "4711"
    assert bench.head.emission(bench.now()) == pytest.approx(0.4)


def test_off_now_waits_for_nothing_and_its_answer_answers_nothing_else() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    laser.link.write(b"?MD")  # cut short
    before = bench.now()
    laser.darken()
    assert bench.now() == before
    assert bench.head.emission(bench.now()) == 0.0
    assert laser.ask("GSN") == "4711"
    laser.force_off()


def test_a_lost_command_is_given_again() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    bench.line.command_faults.append(lambda _: b"")
    laser.stop_emission()
    assert bench.head.emission(bench.now()) == 0.0
    bench.line.command_faults.append(lambda data: data[:-1])  # without CR: the next command runs into it
    assert laser.ask("GSN") == "4711"


def test_a_late_answer_never_answers_the_next_question() -> None:
    """Two readings of the same quantity: the second must be the present one, however late the first arrives."""
    for delay in (0.3, 0.49, 0.51, 0.6, 1.0, 1.5, 2.5, 4.0):
        bench = LaserBench()
        laser = emitting(bench)
        bench.line.answer_faults.append(late(delay))
        first = [laser.measured_mw()]
        laser._set_power(0.7)
        assert laser.measured_mw() == pytest.approx(70.0), delay
        assert first == [pytest.approx(40.0)]


def test_an_answer_that_comes_twice_answers_once() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    bench.line.answer_faults.append(lambda data: [(0.0, data + data)])
    assert laser.measured_mw() == pytest.approx(40.0)
    bench.head.level = 0.7
    assert laser.measured_mw() == pytest.approx(70.0)


def test_emission_is_not_asked_for_twice() -> None:
    """LOn is no setting: when its answer is lost, the status says whether it was understood."""
    bench = LaserBench()
    laser = bench.connect()
    laser.arm(40.0)
    asked = []
    bench.line.command_faults.extend([lambda data: (asked.append(data), data)[1]] * 100)
    bench.line.answer_faults.append(lost)
    laser.emit()
    assert asked[0] == b"?LOn\r"
    assert asked.count(b"?LOn\r") == 1
    assert laser.measured_mw() == pytest.approx(40.0)


def test_a_dead_laser_ends_in_one_line() -> None:
    bench = LaserBench()
    laser = bench.connect()
    bench.line.command_faults.extend([lambda _: b""] * 100)
    before = bench.now()
    with pytest.raises(NoAnswer, match=r"laser 532 nm did not answer \?MDP within 0\.5 s\. Remedy"):
        laser.measured_mw()
    assert bench.now() - before < 10.0


def test_nonsense_for_ever_ends_in_one_line() -> None:
    bench = LaserBench()
    laser = bench.connect()
    bench.line.answer_faults.extend([lambda _: [(0.0, b"!MDP1q.2\r")]] * 100)
    with pytest.raises(Garbled, match=r"answered \?MDP with '1q\.2', which makes no sense"):
        laser.measured_mw()


@pytest.mark.parametrize("deaf", [b"LOf", b"TPP", b"SAS", b"SOM"])
def test_a_failed_step_of_switching_off_does_not_stop_the_others(deaf: bytes) -> None:
    """Each thing that could bring light back is gone by two of the steps, or by a step that has nothing else to do."""
    bench = LaserBench()
    laser = emitting(bench)
    bench.head.mode |= int(Mode.AUTOSTART)
    bench.head.stored_mode = bench.head.mode

    @dataclass
    class Deaf:
        """Drops every command with these letters."""

        letters: bytes

        def __call__(self, data: bytes) -> bytes:
            return b"" if self.letters in data else data

    bench.line.command_faults.extend([Deaf(deaf)] * 100)
    with pytest.raises(DeviceError, match=deaf.decode()):
        laser.force_off()
    assert bench.head.emission(bench.now()) == 0.0
    assert (bench.head.on_since is None) == (deaf != b"LOf")
    assert (bench.head.level == 0.0) == (deaf != b"TPP")
    assert not bench.head.stored_mode & Mode.AUTOSTART
    assert bool(bench.head.stored_mode & Mode.RELEASE) == (deaf == b"SOM")


@pytest.mark.parametrize("told", [False, True])
def test_a_silent_laser_is_closed_in_the_time_of_one_question(told: bool) -> None:
    """Its adapter lives, it hears nothing. Expected: three attempts at LOf, then the port is the supervisor's."""
    bench = LaserBench()
    laser = emitting(bench)
    bench.line.firmware.feed = lambda data, now: []  # type: ignore[method-assign]
    if told:
        laser.darken()
    begun = bench.now()
    with pytest.raises(NoAnswer, match=r"LOf"):
        laser.close()
    assert 3.0 < bench.now() - begun < 9.5


def test_nothing_but_commands_drives_the_laser_once_it_is_connected() -> None:
    """Its digital and analogue inputs are no gates: what hangs on them may not modulate the light."""
    inputs = Mode.DIGITAL | Mode.ANALOG | Mode.ADHOC
    bench = LaserBench(head=LaserHead(532.0, 100.0, stored_mode=int(inputs | Mode.APC)))
    laser = emitting(bench)
    assert not laser.mode() & inputs and laser.mode() & Mode.APC


def test_unplug_and_replug() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    bench.line.unplug()
    with pytest.raises(Unplugged, match="laser 532 nm"):
        laser.status()
    assert bench.head.emission(bench.now()) > 0.0  # no watchdog: this is why interlocks exist
    bench.line.plug()
    bench.connect()
    assert bench.head.emission(bench.now()) == 0.0


def test_closing_switches_off_and_gives_the_port_back_even_when_it_is_gone() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    laser.close()
    assert bench.head.emission(bench.now()) == 0.0
    laser = emitting(bench)
    bench.line.unplug()
    with pytest.raises(Unplugged):
        laser.close()


def test_the_emulated_laser_answers_unknown_commands_and_bad_arguments() -> None:
    """From Odemis's and Micro-Manager's descriptions: !UK, x."""
    firmware = OmicronFirmware(LaserHead(532.0, 100.0))
    for question, answer in (
        (b"?XyZ\r", b"!UK\r"),
        (b"?gfw\r", b"!UK\r"),
        (b"?SLPG00\r", b"!SLPx\r"),
        (b"?TPP101\r", b"!TPPx\r"),
        (b"?ROM9\r", b"!ROMx\r"),
        (b"?GLP\r", b"!GLP000\r"),
        (b"?LOn\r", b"!LOn>\r"),
    ):
        assert [data for _, data in firmware.feed(question, 0.0)] == [answer]
