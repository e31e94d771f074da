"""The link: ports by URL, time limits, framing of whatever a cable makes of a stream, the byte log and its replay."""

from __future__ import annotations

import os
import string
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from replay import ReplayPeer, read_log
from serial_fakes import BoardBench, Bus, LaserBench, TableBench

from disco_twin.firmware.wire import lost
from hw.base.clock import VirtualClock
from hw.base.errors import DiscoError, InputError, Unplugged
from hw.devices.omicron import OmicronLaser
from hw.devices.omicron_protocol import OmicronFramer
from hw.devices.zaber import ZaberFramer, checksum, parse
from hw.serial.bytelog import HEADER, ByteLog, Event
from hw.serial.link import Framer, Inbox, LineFramer, Link
from hw.serial.ports.protocol_memory import attach

# ---- ports and time limits


@pytest.mark.parametrize("url", ["memory://nobody", "/dev/does-not-exist", "nonsense://x", "socket://127.0.0.1:1"])
def test_a_port_that_cannot_be_opened_is_one_line(url: str) -> None:
    with pytest.raises(Unplugged) as refused:
        Link(url, 9600, "turntable", VirtualClock())
    text = str(refused.value)
    assert text.startswith(f"{url}: the port of turntable cannot be opened")
    assert "Remedy" in text
    assert "\n" not in text


def test_unplugging_is_noticed_by_reading_and_by_writing() -> None:
    bench = LaserBench()
    for use in (lambda link: link.read(0.1), lambda link: link.write(b"?GFw\r")):
        link = bench.link("laser")
        bench.line.unplug()
        with pytest.raises(Unplugged, match="the port of laser"):
            use(link)
        with pytest.raises(Unplugged, match="there is no such device"):
            bench.link("laser")
        bench.line.plug()
        bench.link("laser")
        with pytest.raises(Unplugged):  # an old handle stays dead
            use(link)
        link.close()
        link.close()


def test_two_programs_cannot_speak_to_one_device() -> None:
    master, slave = os.openpty()
    try:
        first = Link(os.ttyname(slave), 9600, "turntable", VirtualClock())
        with pytest.raises(Unplugged, match=r"turntable cannot be opened: another program uses it.*Remedy: end"):
            Link(os.ttyname(slave), 9600, "turntable", VirtualClock())
        first.close()
        Link(os.ttyname(slave), 9600, "turntable", VirtualClock()).close()
    finally:
        os.close(master)
        os.close(slave)


def test_what_was_heard_is_what_came_since_the_last_question() -> None:
    """For errors about other devices: an older answer would accuse the wrong one."""
    bench = LaserBench()
    link = bench.link("laser")
    assert link.heard() == "nothing answered"
    link.write(b"?GSN\r")
    while link.read(0.1):
        pass
    assert link.heard() == repr(b"!GSN4711\r") + " came"
    link.write(b"silence")
    link.read(0.1)
    assert link.heard() == "nothing answered"


def test_what_came_before_a_command_is_no_part_of_its_answer() -> None:
    bench = LaserBench()
    inbox: Inbox[str] = Inbox(bench.link("meter"), LineFramer())
    bench.line.say(b"old\r\n*1.2")
    bench.clock.sleep(1.0)
    inbox.clear()
    bench.line.say(b"3E-3\r\n")
    assert inbox.next(lambda _: True, 1.0) == "3E-3"
    bench.line.say(b"one\r\ntwo\r\n")
    assert inbox.next(lambda _: True, 1.0) == "one"
    inbox.clear()
    assert inbox.next(lambda _: True, 0.1) is None


def test_draining_drops_everything_and_gives_up_on_a_device_that_never_falls_silent() -> None:
    bench, framer = LaserBench(), OmicronFramer()
    inbox: Inbox[str] = Inbox(bench.link("laser"), framer)
    bench.line.say(b"$note\r!one\r!two\r!thr")
    assert inbox.next(lambda _: True, 1.0) == "!one"
    assert inbox.drain(0.5)
    bench.line.say(b"ee\r")
    assert inbox.next(lambda _: True, 0.5) is None  # neither what was waiting nor the rest of what had begun
    bench.line.say(b"$unasked\r")
    bench.clock.sleep(1.0)
    inbox.clear()
    assert framer.notices == ["note", "unasked"]  # what the laser says unasked is kept until it is taken
    for k in range(200):
        bench.line._send([(0.1 * k, b"x")], bench.now())
    begun = bench.now()
    assert not inbox.drain(0.5)
    assert 5.0 <= bench.now() - begun < 5.7


def test_closing_never_raises_and_ends_the_log(tmp_path: Path) -> None:
    """A cable that was pulled: what fails in closing is written down, and stops no other device from being closed."""
    link = LaserBench(log=tmp_path / "laser.log").link("laser")

    def fails() -> None:
        raise OSError(5, "input/output error")

    link._port.close = fails  # type: ignore[method-assign]
    link.close()
    link.close()
    noted = (tmp_path / "laser.log").read_text().splitlines()
    assert [line.split()[1] for line in noted[1:]] == ["open", "!", "close"]


def test_waiting_ends_at_the_limit_and_no_earlier() -> None:
    bench = LaserBench()
    inbox: Inbox[str] = Inbox(bench.link("laser"), OmicronFramer())
    before = bench.now()
    assert inbox.next(lambda _: True, 0.5) is None
    assert 0.5 <= bench.now() - before < 0.53


# ---- framing, in whatever pieces the bytes come

WORDS = st.text(string.ascii_letters + string.digits + ".-", min_size=1, max_size=12)
PIECES = st.lists(st.integers(1, 7), min_size=1, max_size=30)


def in_pieces(framer: Framer[object], data: bytes, sizes: list[int]) -> list[object]:
    """Feed a stream in pieces of the given sizes, over and over."""
    got, at, i = list[object](), 0, 0
    while at < len(data):
        got += framer.feed(data[at : at + sizes[i % len(sizes)]])
        at += sizes[i % len(sizes)]
        i += 1
    return got


@given(st.lists(WORDS, min_size=1, max_size=5), PIECES)
@pytest.mark.parametrize(
    ("make", "frame", "unframe"),
    [
        (OmicronFramer, lambda w: f"!{w}\r".encode(), lambda m: m[1:]),
        (LineFramer, lambda w: f"{w}\r\n".encode(), lambda m: m),
        (ZaberFramer, lambda w: f"@01 1 07 OK IDLE -- {w}\r\n".encode(), lambda m: m.data),
    ],
)
def test_messages_survive_any_cut(
    make: Callable[[], Framer[object]],
    frame: Callable[[str], bytes],
    unframe: Callable[[object], str],
    words: list[str],
    sizes: list[int],
) -> None:
    """Split at any byte, several in one read: the messages are those that were sent."""
    assert [unframe(m) for m in in_pieces(make(), b"".join(map(frame, words)), sizes)] == words


@given(WORDS, WORDS, st.data(), PIECES, st.integers(0, 5))
def test_a_laser_message_in_mid_answer_is_taken_out(
    word: str, notice: str, data: st.DataObject, sizes: list[int], nuls: int
) -> None:
    answer = f"!{word}\r".encode()
    at = data.draw(st.integers(0, len(answer) - 1))
    stream = b"\0" * nuls + answer[:at] + f"${notice}\r".encode() + answer[at:]
    framer = OmicronFramer()
    assert in_pieces(framer, stream, sizes) == [f"!{word}"]  # type: ignore[arg-type]
    assert framer.notices == [notice]


@given(st.binary(max_size=20).filter(lambda b: not set(b) & set(b"$@!/#\r\n")), WORDS, PIECES)
def test_garbage_before_an_answer_does_not_hide_it(garbage: bytes, word: str, sizes: list[int]) -> None:
    assert in_pieces(OmicronFramer(), garbage + f"!{word}\r".encode(), sizes) == [f"!{word}"]  # type: ignore[arg-type]
    body = f"01 1 07 OK IDLE -- {word}"
    line = garbage + f"@{body}:{checksum(body)}\r\n".encode()
    (reply,) = in_pieces(ZaberFramer(), line, sizes)  # type: ignore[arg-type]
    assert (reply.data, reply.id, reply.checked) == (word, 7, True)  # type: ignore[attr-defined]


@given(st.binary(max_size=200), PIECES)
def test_no_framer_ever_raises(noise: bytes, sizes: list[int]) -> None:
    for framer in (OmicronFramer(), ZaberFramer(), LineFramer()):
        in_pieces(framer, noise, sizes)  # type: ignore[arg-type]


def test_zaber_checksum_is_the_one_that_was_observed() -> None:
    """From the wire of Zaber's own client, and from its protocol's manual."""
    assert checksum("1 1 00 get pos") == "2C"
    assert checksum("01 tools echo") == "8F"


@given(st.integers(1, 255), st.data())
def test_a_zaber_answer_with_any_wrong_byte_is_dropped(mask: int, data: st.DataObject) -> None:
    body = "01 1 42 OK IDLE -- 256000"
    line = bytearray(f"@{body}:{checksum(body)}".encode())
    at = data.draw(st.integers(1, len(line) - 4))  # one byte between the first character and the colon
    line[at] ^= mask
    reply = parse(line.decode("latin-1"))
    assert reply is None or not reply.checked


# ---- the byte log


def test_a_log_is_appended_to_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "logs" / "laser.log"
    for time in (1.5, 2.5):
        log = ByteLog(path)
        log.note(time, ">", b"?GFw\r")
        log.note(time + 0.1, "<", b"!GFwLuxX\xa74\xa71\r")
        log.close()
    lines = path.read_text().splitlines()
    assert lines[:2] == [HEADER, "1.500000 > 3f4746770d"]
    assert [e.data for e in read_log(path)] == [b"?GFw\r", b"!GFwLuxX\xa74\xa71\r"] * 2
    path.write_text(path.read_text() + "3.0 < 21")  # cut off by a crash
    assert len(read_log(path)) == 4


@pytest.mark.parametrize("text", ["", "something else\n", HEADER + "\n1.0 ? 00\n", HEADER + "\n1.0 < 0g\n", "\xff"])
def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.log"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"x\.log"):
        read_log(path)


def exercise_laser(laser: OmicronLaser) -> tuple[object, ...]:
    laser.arm(20.0)
    laser.emit()
    result = (laser.identity, laser.measured_mw(), laser.status(), laser.mode())
    laser.close()
    return result


def test_a_recorded_session_replays_with_its_faults(tmp_path: Path) -> None:
    """The same driver on the log alone: the same bytes, the same results, at the same times."""
    bench = LaserBench(log=tmp_path / "laser.log")
    bench.line.answer_faults.extend([None, lost, None, None, lambda d: [(0.7, d)]])
    expected = exercise_laser(bench.connect())
    events = read_log(tmp_path / "laser.log")
    clock = VirtualClock()
    peer = ReplayPeer(events, clock)
    laser = OmicronLaser(Link(attach("replay", peer), 500_000, "laser 532 nm", clock), 532.0)
    assert exercise_laser(laser) == expected
    assert peer.finished
    assert clock.now() == pytest.approx(bench.now(), abs=0.05)


def test_a_replay_refuses_other_bytes(tmp_path: Path) -> None:
    peer = ReplayPeer([Event(0.0, ">", b"?GFw\r"), Event(0.1, "<", b"!GFw1\r")], VirtualClock())
    peer.receive(b"?G")
    with pytest.raises(DiscoError, match="where the log has"):
        peer.receive(b"SN\r")
    peer = ReplayPeer([Event(0.0, "<", b"x")], VirtualClock())
    with pytest.raises(DiscoError, match="where the log has"):
        peer.receive(b"?")


def exercise_board(bench: BoardBench) -> None:
    board = bench.connect()
    board.set_mirrors(12, 4000)
    board.close()


def exercise_table(bench: TableBench) -> None:
    table = bench.connect()
    table.home()
    table.close()


@pytest.mark.parametrize(("make", "exercise"), [(BoardBench, exercise_board), (TableBench, exercise_table)])
def test_the_other_drivers_replay_too(
    tmp_path: Path, make: Callable[..., Bus], exercise: Callable[[Bus], None]
) -> None:
    exercise(make(log=tmp_path / "x.log"))
    bench = make(name="replayed")
    peer = ReplayPeer(read_log(tmp_path / "x.log"), bench.clock)
    attach(bench.name, peer)
    exercise(bench)
    assert peer.finished
