"""A long capture in which everything goes wrong again and again: does anything grow, and is every image right?

20,000 small images through the emulated serial rig, in virtual time. Every 50 images something new goes wrong
(`benchmarks.faults`); every 400 images the program is told to end, and a second one, which continues, is killed by
SIGKILL somewhere in its next hundreds. The first program takes over again, as an operator would, so that one process
takes most of the images: its memory, its open files and the processor time of an image are compared at the begin and at
the end. The stream is compared, bit for bit, with that of an undisturbed capture.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import faults
from benchmarks.faults import KINDS, RIG, SEED, Fault, Glow, Hung, Timetable, Undisturbed
from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.twin_rig import TwinRig
from hw.base.errors import DiscoError
from hw.interface import Aim
from pipeline.capture.loop import Interrupted, capture
from pipeline.plan.plan import Plan
from pipeline.stream.stream import StreamReader

IMAGES, QUICK = 20_000, 500
FAULT_EVERY, KILL_EVERY = 50, 400  # images
CONNECT_S = 25.0  # and home, and compare with the stored images
SENSOR = lars3_sensor(RIG)


def plan(images: int) -> Plan:
    """About so many images: 2 cameras, 3 angles, 3 lasers."""
    spots = images // 6
    steps = np.random.default_rng(SEED).integers(1850, 2250, (spots, 2))
    aims = tuple(Aim(k * 3 // spots, int(u), int(v)) for k, (u, v) in enumerate(steps))
    return Plan(("front", "back"), tuple(np.deg2rad(RIG.turntable_angles_deg).tolist()), aims, lasers=3)


@dataclass
class Soak:
    """One long capture. samples: (images, resident MB, open files, processor seconds), as it goes on."""

    plan: Plan
    folder: Path
    ordinary: Undisturbed  # what FAULT_EVERY undisturbed images take: a fault falls somewhere within
    emulation: Emulation
    stops: Counter[str] = field(default_factory=Counter)
    samples: list[tuple[int, float, int, float]] = field(default_factory=list)
    drawn: int = 0
    killing: bool = False

    def progress(self, done: int, total: int) -> None:
        """Something goes wrong now and then."""
        if done % FAULT_EVERY == 0 and not self.killing:
            self.arm(KINDS[self.drawn % len(KINDS)])
        if done % KILL_EVERY == 0 and not self.killing and done < total:
            raise KeyboardInterrupt
        if done % 100 == 0:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            files = len(os.listdir("/proc/self/fd"))
            self.samples.append((done, pages * os.sysconf("SC_PAGESIZE") / 2**20, files, time.process_time()))

    def arm(self, kind: str) -> None:
        """Prepare the next fault of a kind; one that is due to come and has not is forgotten."""
        clock = self.emulation.clock
        assert isinstance(clock, Timetable)
        drawn = faults.draw(self.drawn, sorted(self.ordinary.messages))
        line = drawn.line if kind == drawn.kind else "board"
        self.drawn += 1
        if kind != "kill" or self.killing:
            for cable in self.emulation.cables.values():
                cable.answer_faults.clear()
                cable.command_faults.clear()
            fault = Fault(kind, line, drawn.when, drawn.detail)
            faults.arm(fault, self.emulation, self.ordinary, self.folder.with_suffix(".state"))
            if kind not in faults.MESSAGE_KINDS:  # by the time that it takes to connect
                clock.at = clock.now() + drawn.when * (CONNECT_S + self.ordinary.seconds)

    def run(self) -> None:
        """Until it is complete. Raises: Hung."""
        clock = self.emulation.clock
        assert isinstance(clock, Timetable)
        clock.limit = clock.now() + 20.0 * self.ordinary.seconds * len(self.plan) / FAULT_EVERY
        while True:
            try:
                capture(self.emulation.serial_rig(), self.plan, self.folder, self.progress, SENSOR)
                return
            except Interrupted:
                self.stops["told to end"] += 1
                self.continue_elsewhere()
            except DiscoError as error:
                self.stops[type(error).__name__] += 1
                faults.mend(self.emulation)

    def continue_elsewhere(self) -> None:
        """Another process goes on, and dies; its devices are ours then."""
        child = os.fork()
        if child == 0:
            try:
                self.killing = True
                self.arm("kill")
                capture(self.emulation.serial_rig(), self.plan, self.folder, None, SENSOR)
            finally:
                os._exit(0)
        os.waitpid(child, 0)
        state = self.folder.with_suffix(".state")
        if state.exists():  # else it was finished before it was due to die
            clock = self.emulation.clock
            self.emulation = faults.revived(state)
            self.emulation.clock.limit = clock.limit  # type: ignore[attr-defined]
            state.unlink()
            self.stops["killed"] += 1


def undisturbed(folder: Path, plan: Plan) -> tuple[float, Counter[str]]:
    """The capture without faults: its (virtual) seconds and the messages of every line."""
    emulation = Emulation(TwinRig(RIG, Glow(), SEED), Timetable())
    sent: Counter[str] = Counter()
    for name, line in emulation.cables.items():
        setattr(line, "receive", faults.counting(line.receive, name, sent))  # noqa: B010 - a spy on one line
    capture(emulation.serial_rig(), plan, folder)
    return emulation.clock.now(), sent


def run(quick: bool) -> dict[str, Any]:
    """20,000 images; 500 if quick."""
    whole = plan(QUICK if quick else IMAGES)
    with tempfile.TemporaryDirectory() as scratch:
        seconds, sent = undisturbed(Path(scratch, "whole"), whole)
        share = FAULT_EVERY / len(whole)
        ordinary = Undisturbed(
            Path(scratch, "whole"), share * seconds, {name: max(1, int(share * n)) for name, n in sent.items()}
        )
        soak = Soak(whole, Path(scratch, "soaked"), ordinary, Emulation(TwinRig(RIG, Glow(), SEED), Timetable()))
        hung = 0
        try:
            soak.run()
        except Hung:
            hung = 1
        lost, wrong = faults.differences(Path(scratch, "whole"), soak.folder)
        with StreamReader(soak.folder) as stream:
            count = len(stream)
    return {"images": count, "lost": lost, "wrong": wrong, "hung": hung, **growth(soak.samples)} | {
        "rows": [{"stop": name, "times": times} for name, times in soak.stops.most_common()],
        "hazards": soak.emulation.bench.hazards,
    }


def growth(samples: list[tuple[int, float, int, float]]) -> dict[str, float]:
    """Memory, open files and milliseconds an image, over the second and over the last fifth of the samples."""
    fifth = max(1, len(samples) // 5)
    early, late = np.array(samples[fifth : 2 * fifth]), np.array(samples[-fifth:])

    def median_ms(some: Any) -> float:
        steps = np.diff(np.array(some), axis=0)
        usual = steps[steps[:, 0] == 100]
        return float(1e3 * np.median(usual[:, 3]) / 100) if len(usual) else 0.0

    return {
        "memory_mb": float(np.median(early[:, 1])),
        "memory_end_mb": float(np.median(late[:, 1])),
        "files": float(np.median(early[:, 2])),
        "files_end": float(np.median(late[:, 2])),
        "image_ms": median_ms(samples[: 2 * fifth]),
        "image_end_ms": median_ms(samples[-2 * fifth :]),
    }
