"""Images per second from the stream's files to readings at the vertices of a scan (thesis 5.1: 50 on a 3 GHz Xeon).

Frames of 24 views are captured by the twin (`benchmarks.frames`), one spot an angle; the stream that is timed holds
them over and over, as if every angle had many spots. Timed is all that a run does with an image: reading, checksum,
decoding, radiance, readings, sums for the noise. Rounds alternate with two yardsticks that tell how busy the machine
is, a plain copy of as many bytes as an image has and decoding alone, and with the plain computation of the same
readings in double precision, whose deviation is told in units of a reading's noise.

`images_per_s` is by the wall clock. On a machine with other work it says how much of it was left over, and
`images_per_cpu_s_two_cores`, two images' worth of processor seconds, is the fair figure.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.frames import capture_frames
from hw.base.resources import usable_cores
from hw.interface import Aim
from pipeline.calibrate.calibration import nominal_calibration
from pipeline.plan.plan import Plan
from pipeline.reconstruct.samples.image_operators import footprint_reading
from pipeline.reconstruct.samples.resample import BatchResult, ViewReader, resample
from pipeline.stream.stream import StreamReader, StreamWriter

MAX_VIEW_DEG = 75.0
ETA = 1.3


def run(quick: bool = False) -> dict[str, Any]:
    """Keys of benchmarks.md, CPU milliseconds an image of each stage, and the error."""
    from disco_twin.camera.lars3 import lars3_sensor

    angles, spots, rounds = (2, 16, 3) if quick else (12, 24, 5)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        experiment = capture_frames(folder, angles, 20_000 if quick else 100_000, angles, 2000 if quick else 8924)
        rig, mesh = experiment.scene.rig, experiment.scan
        calibration = nominal_calibration(rig, lars3_sensor(rig))
        plan = repeated(folder, spots)
        cpu, readings = time.process_time(), []
        for view in range(plan.views):
            camera = calibration.view_camera(view)
            readings.append({"footprint": footprint_reading(mesh, camera, ETA, MAX_VIEW_DEG)})
        cpu = (time.process_time() - cpu) / plan.views
        readers = [ViewReader.of(view, calibration, mesh, readings[view]) for view in range(plan.views)]
        lit = np.ones(len(plan.spots))
        figures: dict[str, list[float]] = {}

        def note(name: str, count: int, work: Callable[[], object]) -> None:
            spent, start = time.process_time(), time.perf_counter()
            work()
            figures.setdefault(f"{name}images_per_s", []).append(count / (time.perf_counter() - start))
            figures.setdefault(f"{name}cpu_ms", []).append(1e3 * (time.process_time() - spent) / count)

        with StreamReader(folder / "repeated") as stream:
            some = [stream.plan.index(a) for a in stream.plan.addresses() if a.kind == "spot"]
            few = some[:: max(1, len(some) // 20)]
            size = 3 * rig.cameras[0].width * rig.cameras[0].height
            source, target = np.ones(size, np.uint8), np.empty(size, np.uint8)

            def copy() -> None:
                for _ in some:
                    np.copyto(target, source)

            for _ in range(rounds):
                note("", len(some), lambda: [None for _ in resample(stream, calibration, readers, lit, {})])
                note("copy_", len(some), copy)
                note("decode_", len(some), lambda: [None for _ in stream.read_many(some, usable_cores())])
                note("plain_", len(few), lambda: [plain(stream, calibration, readings, i) for i in few])
            first = next(iter(resample(stream, calibration, readers[:1], lit, {})))
            error = error_over_noise(first, stream, calibration, readings)
    result: dict[str, Any] = {
        "images": len(some),
        "views": len(readers),
        "vertices": len(mesh.vertices),
        "width": rig.cameras[0].width,
        "height": rig.cameras[0].height,
        "threads": usable_cores(),
        "error_over_noise": error,
        "set_up_cpu_s_per_view": cpu,
    }
    own = figures["cpu_ms"]
    figures["images_per_cpu_s_two_cores"] = [2e3 / ms for ms in own]
    for yardstick in ("copy", "decode", "plain"):
        figures[f"cpu_over_{yardstick}"] = [a / b for a, b in zip(own, figures[f"{yardstick}_cpu_ms"], strict=True)]
    for name, values in figures.items():
        result |= {name: statistics.median(values), f"{name}_min": min(values), f"{name}_max": max(values)}
    return {"name": "resample", "quick": quick, **result}


def repeated(folder: Path, spots: int) -> Plan:
    """Write `folder / "repeated"`: every view's images again and again, as those of `spots` spots an angle.

    Where the sweep put no spot at an angle, the camera's images at the others stand in.
    """
    with StreamReader(folder / "capture") as captured:
        old = captured.plan
        aims = tuple(Aim(angle, spot, 0) for angle in range(len(old.angles_rad)) for spot in range(spots))
        plan = Plan(old.cameras, old.angles_rad, aims, old.lasers)
        lit = [i for i in range(len(old)) if old.address(i).kind == "spot"]
        with StreamWriter(folder / "repeated", plan) as stream:
            for address in plan.addresses():
                own = [i for i in lit if old.address(i).view == address.view]
                own = own or [i for i in lit if old.camera_of(old.address(i).view) == old.camera_of(address.view)]
                index = own[(address.spot * plan.lasers + address.laser) % len(own)]
                stream.append(address, captured.read(index), captured.meta(index))
    return plan


def plain(stream: StreamReader, calibration: Any, readings: Any, index: int) -> Any:
    """(V,) readings of one image in double precision, as pi L / (F_t Phi) with F_t(w_i) = 1."""
    address = stream.plan.address(index)
    image = calibration.radiance(stream.read(index), address.view, address.laser)
    scale = np.pi / stream.meta(index).photodiode_w
    return readings[address.view]["footprint"].operator @ image.radiance.ravel().astype(np.float64) * scale


def error_over_noise(result: BatchResult, stream: StreamReader, calibration: Any, readings: Any) -> float:
    """Largest deviation of a reading from the plain one, in standard deviations of that reading."""
    reader, worst = result.batch.reader, 0.0
    rows = reader.rows["footprint"]
    operator = readings[reader.view]["footprint"].operator[rows]
    for value, scale, address in zip(result.value["footprint"], result.scale, result.batch.addresses, strict=True):
        index = stream.plan.index(address)
        image = calibration.radiance(stream.read(index), reader.view, address.laser)
        variance = operator.multiply(operator) @ image.variance.ravel().astype(np.float64) * scale**2
        exact = plain(stream, calibration, readings, index)[rows]
        worst = max(worst, float(np.nanmax(np.abs(value - exact) / np.sqrt(variance))))
    return worst
