"""Does a capture keep the thesis's pace? 15 images of 768 x 496 a second, for ten minutes.

Everything but the light is what a laboratory runs: serial rig, supervisor, drivers, capture loop, codec, journal. The
devices are emulated by another process on pseudo-terminals, with the baud rates, latencies and settling times of real
ones. The camera hands over stored frames of the sensor model, at the times of a Lars III that runs freely at 30 frames
a second: an exposure begins with the next frame. So an image takes two frames if all that happens between two exposures
(mirrors, gates, photodiode, codec, journal) fits into one; else it takes three, and is `late`.

In the end every image is read back and compared (`wrong`), and the stream must be complete (`lost`). The devices run
before ordinary processes, where the system allows it (`devices_first`). `processor_ms`: of the program, an image.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.device_priority import come_first
from benchmarks.faults import Glow
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.serve import Server
from disco_twin.emulation.served_rig import emulated_devices
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.interface import Aim, gate_open
from hw.record import RawImage
from hw.rig.connect import Connector
from hw.rig.rig_rules import load_rig_file
from hw.rig.serial_rig import SerialRig
from pipeline.capture.loop import capture
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan
from pipeline.stream.stream import StreamReader

WIDTH, HEIGHT = 768, 496
FRAME_S = 1 / 30
IMAGES, QUICK = 9000, 300
STORED = 12  # frames
RIG = TwinRigConfig(cameras=(CameraConfig(name="front", position_mm=(450, 60, 100), width=WIDTH, height=HEIGHT),))


class FullGlow(Glow):
    """A spot with tails on a textured object, at full size."""

    size = (HEIGHT, WIDTH)
    scale = 16.0


def stored_frames() -> list[RawImage]:
    """What the sensor makes of spots at several places, in all lasers, with its noise."""
    twin, frames = TwinRig(RIG, FullGlow(), seed=1), []
    with twin:
        twin.turntable.move(0.0)
        for k in range(STORED):
            twin.projector.move(1900 + 25 * k, 1950 + 15 * k)
            with gate_open(twin.lasers[k % 3]):
                frames.append(twin.cameras[0].expose())
    return frames


class StoredCamera:
    """A camera that runs freely at 30 frames a second. `ended`: when each exposure did."""

    name = "front"

    def __init__(self, frames: list[RawImage]) -> None:
        self.frames, self.ended = frames, list[float]()
        self._begun = time.monotonic()

    def expose(self) -> RawImage:
        """The next whole frame."""
        elapsed = time.monotonic() - self._begun
        end = self._begun + (np.ceil(elapsed / FRAME_S) + 1) * FRAME_S
        time.sleep(max(0.0, end - time.monotonic()))
        self.ended.append(float(end))
        return self.frames[(len(self.ended) - 1) % len(self.frames)]


def devices(folder: Path, ready: Connection) -> None:
    """Serves the emulated devices until the other end of the pipe is closed."""
    first = come_first()
    emulation = emulated_devices(RIG, seed=1)
    with Server(emulation.cables, folder) as server:
        (folder / "rig.toml").write_text(rig_file_of(RIG, server.urls))
        ready.send(first)
        ready.poll(None)
        with suppress(EOFError):
            ready.recv()


def run(quick: bool) -> dict[str, Any]:
    """9000 images, ten minutes; 300 if quick."""
    count = QUICK if quick else IMAGES
    spots = count // 3
    random = np.random.default_rng(1)
    aims = tuple(Aim(0, int(u), int(v)) for u, v in random.integers(1500, 2600, (spots, 2)))
    plan = Plan(("front",), (0.0,), aims, lasers=3)
    camera = StoredCamera(stored_frames())
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        ours, theirs = multiprocessing.get_context("spawn").Pipe()
        server = multiprocessing.get_context("spawn").Process(target=devices, args=(folder, theirs), daemon=True)
        server.start()
        theirs.close()
        first = bool(ours.recv())
        begun = time.process_time()
        rig = SerialRig(Connector(load_rig_file(folder / "rig.toml")), [camera], armed=True)
        capture(rig, plan, folder / "capture")
        used = time.process_time() - begun
        ours.close()
        server.join()
        times = np.diff(camera.ended[1:])  # the first is the silhouette
        frames = np.rint(times / FRAME_S)
        lost, wrong = differences(folder / "capture", camera.frames, len(plan))
    return {
        "images": len(camera.ended),
        "images_per_s": len(times) / float(times.sum()),
        "late": int((frames > 2).sum()),
        "lost": lost,
        "wrong": wrong,
        "seconds": float(times.sum()),
        "devices_first": first,
        "processor_ms": 1e3 * used / len(plan),
    }


def differences(folder: Path, frames: list[RawImage], count: int) -> tuple[int, int]:
    """Images that are missing, and those that are not what the camera handed over."""
    with StreamReader(folder) as stream:
        wrong = 0
        for index in range(len(stream)):
            found, frame = stream.read(index), frames[index % len(frames)]
            wrong += not (np.array_equal(found.charge, frame.charge) and np.array_equal(found.exponent, frame.exponent))
        return count - len(stream), wrong
