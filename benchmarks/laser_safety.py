"""How long does a laser go on after the program should have switched it off? Measured in the emulated devices.

Every trial is a capture by a program of its own, with the real drivers and guards, through pseudo-terminals, in real
time, that ends by one of the events: connecting to a laser that somebody left on; the end of the program; an exception;
SIGINT, SIGTERM, SIGHUP, SIGQUIT; SIGKILL; the end of the program with a signal on its heels (`closing`). The emission
of all three lasers is sampled every millisecond. Waits that have nothing to do with switching off (the start of
emission, the boot of the board) are shortened.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

import disco_twin.firmware.omicron as omicron_firmware
import hw.devices.mm_ard as board_driver
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.serve import Server
from disco_twin.emulation.served_rig import emulated_devices
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.clock import WallClock
from hw.devices.omicron_protocol import Mode
from hw.interface import Aim
from hw.record import RawImage
from hw.rig.connect import Connector
from hw.rig.rig_rules import load_rig_file
from hw.rig.serial_rig import SerialRig
from hw.serial.link import Link
from pipeline.capture.loop import capture
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan

SEED = 635532476
LANES = 2
LIMIT_S = 0.1
GIVEN_UP_S = 3.0
START_S = 60.0
CLOSING_S = 0.1  # within it comes the signal after a normal end; closing the rig takes 0.25 s
SIGNALS = {name: signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGKILL")}
EVENTS = ("connect", "exit", "exception", "closing", *SIGNALS)
EACH = 23  # trials
RIG = TwinRigConfig(cameras=(CameraConfig(name="front", position_mm=(450, 60, 100), width=16, height=16),))
PLAN = Plan(("front",), (0.0,), tuple(Aim(0, 1800 + k, 2000) for k in range(400)), lasers=3)


# ---- the program, which ends


class Blink:
    """A camera that exposes for 20 ms, and ends the program at its last image."""

    name = "front"

    def __init__(self, how: str, images: int, told: Connection) -> None:
        self.how, self.left, self.told = how, images, told

    def expose(self) -> RawImage:
        """A dark image."""
        time.sleep(0.02)
        self.left -= 1
        if self.left == 0:
            self.told.send(time.monotonic())
            if self.how in ("exit", "closing"):
                sys.exit(0)
            if self.how == "exception":
                raise RuntimeError("the benchmark's exception")
        return RawImage(np.zeros((16, 16), np.uint8), np.zeros((16, 16), np.uint16))


def program(rig_toml: Path, folder: Path, how: str, images: int, told: Connection) -> None:
    """A capture; says when it is under way (or, if it ends itself, when it does)."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115 - its tracebacks are expected
    board_driver.BOOT_S = 0.05
    rig = SerialRig(Connector(load_rig_file(rig_toml)), [Blink(how, images, told)], armed=True)
    capture(rig, PLAN, folder)


def connecting(url: str, told: Connection) -> None:
    """Opens a laser's port, and does nothing else."""
    link = Link(f"guard://{url}", 500000, "laser", WallClock())
    told.send(time.monotonic())
    link.close()


# ---- who watches


class Watch:
    """Samples the emission of all heads; `last_on` is when any of them emitted last."""

    def __init__(self, emulation: Emulation) -> None:
        self.emulation, self.last_on = emulation, 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def on(self) -> bool:
        """Whether any laser emits."""
        now = time.monotonic()
        return any(head.emission(now) > 0 for head in self.emulation.bench.heads)

    def _run(self) -> None:
        while not self._ended.wait(1e-3):
            if self.on:
                self.last_on = time.monotonic()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()


@dataclass(frozen=True)
class Trial:
    """off_ms: from the event to the last light; None: it did not go out, or the program never got there."""

    event: str
    off_ms: float | None


def watched(numbers: Sequence[int]) -> tuple[list[Trial], list[str]]:
    """The trials of one lane, one after the other, and what their bench saw that must never happen."""
    omicron_firmware.EMISSION_S = 0.05
    emulation = emulated_devices(RIG, seed=1)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    trials = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        lasers = {name: line for name, line in emulation.cables.items() if name.startswith("laser")}
        with Server(emulation.cables, folder) as ports:
            (folder / "rig.toml").write_text(rig_file_of(RIG, ports.urls))
            for number in numbers:
                event = EVENTS[number % len(EVENTS)]
                if event != "connect":
                    trials.append(Trial(event, _captured(context, emulation, folder, event, number)))
        for number in numbers:
            if EVENTS[number % len(EVENTS)] == "connect":
                with Server(lasers, None) as sockets:
                    trials.append(Trial("connect", _connected(context, emulation, sockets.urls, number)))
    return trials, emulation.bench.hazards


def _captured(context: Any, emulation: Emulation, folder: Path, event: str, number: int) -> float | None:
    """Milliseconds of light after the end of a capture."""
    random = np.random.default_rng((SEED, number))
    images = int(random.integers(2, 20))
    ours, theirs = context.Pipe()
    watch = Watch(emulation)
    child = context.Process(target=program, args=(folder / "rig.toml", folder / f"out{number}", event, images, theirs))
    child.start()
    try:
        if not ours.poll(START_S):
            return None
        happened = float(ours.recv())
        if event in SIGNALS:
            time.sleep(float(random.uniform(0, 0.3)))
            if not watch.on:
                return None
            happened = time.monotonic()
            os.kill(child.pid, SIGNALS[event])
        elif event == "closing":
            time.sleep(float(random.uniform(0, CLOSING_S)))
            os.kill(child.pid, int(random.choice([SIGNALS[name] for name in SIGNALS if name != "SIGKILL"])))
        return _until_dark(watch, happened)
    finally:
        _ended(child)
        watch.close()


def _connected(context: Any, emulation: Emulation, urls: dict[str, str], number: int) -> float | None:
    """Milliseconds of light after the port of a laser that is on was opened (a socket, which knows when that is)."""
    name = f"laser{number // len(EVENTS) % len(emulation.bench.heads)}"
    line, head = emulation.cables[name], emulation.bench.heads[int(name[-1])]
    opened: list[float] = []
    before = line.opened

    def spy() -> None:
        opened.append(time.monotonic())
        before()

    head.on_since, head.level, head.mode = time.monotonic() - 60, 1.0, int(Mode.BIAS | Mode.RELEASE)
    setattr(line, "opened", spy)  # noqa: B010 - a spy on one line
    ours, theirs = context.Pipe()
    watch = Watch(emulation)
    child = context.Process(target=connecting, args=(urls[name], theirs))
    child.start()
    try:
        if not ours.poll(START_S) or not opened:
            return None
        return _until_dark(watch, opened[0])
    finally:
        setattr(line, "opened", before)  # noqa: B010
        _ended(child)
        watch.close()


def _until_dark(watch: Watch, happened: float) -> float | None:
    """Milliseconds; None if it is not dark in time, or not dark for long."""
    while watch.on:
        if time.monotonic() > happened + GIVEN_UP_S:
            return None
        time.sleep(1e-3)
    time.sleep(0.2)
    return None if watch.on else 1e3 * max(0.0, watch.last_on - happened)


def _ended(child: BaseProcess) -> None:
    child.join(10)
    if child.is_alive():
        child.kill()
        child.join()


def run(quick: bool) -> dict[str, Any]:
    """207 trials, 23 of each event; two of each if quick."""
    count = len(EVENTS) * (2 if quick else EACH)
    lanes = [range(lane, count, LANES) for lane in range(LANES)]
    with ProcessPoolExecutor(LANES, mp_context=multiprocessing.get_context("spawn")) as pool:
        seen = list(pool.map(watched, lanes))
    trials = [trial for lane, _ in seen for trial in lane]
    times = [t.off_ms for t in trials if t.off_ms is not None]
    rows = []
    for event in EVENTS:
        own = [t.off_ms for t in trials if t.event == event and t.off_ms is not None]
        rows.append({
            "event": event,
            "trials": sum(t.event == event for t in trials),
            "median_ms": statistics.median(own) if own else 0.0,
            "worst_ms": max(own, default=0.0),
        })  # fmt: skip
    return {
        "trials": len(trials),
        "worst_off_ms": max(times, default=0.0),
        "missed": len(trials) - len(times),
        "over_limit": sum(t > 1e3 * LIMIT_S for t in times),
        "hazards": [hazard for _, found in seen for hazard in found],
        "rows": rows,
    }
