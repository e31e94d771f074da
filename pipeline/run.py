"""The pipeline's process: from a capture folder to models and relit images.

It reads CAPTURE (rig.json, sensor.json, scan.ply, plan.json and the stream) and a request, and nothing else; it runs
where no renderer is installed. It writes into WORK:

    calibration.json  samples.npz  model-<method>.npz  relit/<method>/<light>@<view>.npy ((L, H, W) float32)
    relit-variance/<method>/<light>@<view>.npy ((2, L, H, W), where the method states one: `image_variance`)
    pipeline.json     stages, methods, capture statistics, what was left out and why, warnings
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from hw.base.arrays import F32
from hw.base.config import Strict, read_json
from hw.base.errors import DiscoError, InputError, refused_by_the_disk
from hw.base.files import replacing, write_json
from hw.base.resources import measured
from hw.record import Sensor
from pipeline.calibrate.calibrate_rig import measure
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.calibrate.figures import figures
from pipeline.calibrate.target_images import has_targets
from pipeline.capture.silhouettes import examine_silhouettes, silhouettes_of
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh_file import read_scan
from pipeline.geometry.nominal_rig import CameraConfig, RigConfig
from pipeline.model.relightable import WITHOUT, RelightableModel
from pipeline.plan.targets import FOLDER
from pipeline.reconstruct.methods import reconstruct
from pipeline.reconstruct.omissions import omissions
from pipeline.reconstruct.registry import known_methods
from pipeline.reconstruct.samples.image_operators import IMAGE_OPERATORS
from pipeline.reconstruct.samples.samples import Samples, SampleStatistics, take_samples
from pipeline.reconstruct.samples.samples_file import save_samples
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.reconstruct.surface_term.lobe_fit import subtract_reflection
from pipeline.records import NominalRigFile, SensorFile
from pipeline.relight.lights import Light
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh
from pipeline.stream.stream import StreamReader

FORMAT_VERSION = 1
CAPTURE_AGAIN = "delete it, then repeat the capture command"

log = logging.getLogger(__name__)


class RelightRequest(Strict):
    """Lights and held-out cameras (object frame) to relight."""

    views: tuple[CameraConfig, ...] = ()
    lights: tuple[Light, ...] = ()


class Request(Strict):
    """How to reconstruct, and what to relight."""

    format_version: Literal[1]
    reconstruct: ReconstructConfig = ReconstructConfig()
    relight: RelightRequest = RelightRequest()


@dataclass
class Stages:
    """What every stage took, in order: name, seconds, peak resident memory in MiB."""

    rows: list[dict[str, Any]] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a block."""
        with measured() as usage:
            yield
        self.rows.append({"name": name, "seconds": usage.seconds, "peak_mb": usage.peak_mb})
        log.info("%s: %.1f s", name, self.rows[-1]["seconds"])


def gather(
    capture: Path, calibration: Calibration, mesh: trimesh.Trimesh, settings: ReconstructConfig, stages: Stages
) -> tuple[dict[str, Samples], SampleStatistics]:
    """Views, then samples, for every kind of image operator that a method declares (by footprint in any case)."""
    kinds = dict.fromkeys(["footprint", *(known_methods()[name].reads for name in settings.methods)])
    with stages.stage("views"):
        cameras = [calibration.view_camera(v) for v in range(len(calibration.views))]
        operators = {
            kind: [IMAGE_OPERATORS[kind](mesh, camera, settings.eta, settings.max_view_deg) for camera in cameras]
            for kind in kinds
        }
    with stages.stage("samples"), StreamReader(capture) as stream:
        stream.require_complete()
        return take_samples(stream, calibration, mesh, operators, settings)


def relight(models: dict[str, RelightableModel], request: Request, work: Path, stages: Stages) -> dict[str, float]:
    """Relit images of every method, light and view; seconds per method. Models of one surface share the rest."""
    seconds, wanted = dict.fromkeys(models, 0.0), request.relight
    shared: dict[tuple[int, Boundary], tuple[dict[str, LightOnMesh], dict[str, ViewOfMesh]]] = {}
    for method, model in models.items():
        start, surface = time.perf_counter(), (id(model.mesh), model.boundary)
        if surface not in shared:
            cameras = {view.name: PinholeCamera.from_config(view) for view in wanted.views}
            lights = {light.name: model.lit_by(light) for light in wanted.lights}
            shared[surface] = lights, {name: model.seen_by(camera) for name, camera in cameras.items()}
        with stages.stage(f"relight {method}"):
            model.prepare(list(shared[surface][0].values()))
            for light, lit in shared[surface][0].items():
                for view, seen in shared[surface][1].items():
                    _keep(work / "relit" / method / f"{light}@{view}.npy", model.image(lit, seen))
                    _keep(work / "relit-variance" / method / f"{light}@{view}.npy", model.image_variance(lit, seen))
        seconds[method] = time.perf_counter() - start
    return seconds


def _keep(path: Path, array: F32 | None) -> None:
    """Write an array; remove that of another model where there is none."""
    if array is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        np.save(file, array)


def run(capture: Path, work: Path, request: Request, given: Path | None = None) -> dict[str, Any]:
    """Everything; returns what pipeline.json holds. given: a calibration file from before, instead of a new one.

    Raises: InputError for a capture that cannot be reconstructed.
    """
    stages, settings = Stages(), request.reconstruct
    work.mkdir(parents=True, exist_ok=True)
    with stages.stage("calibration"):
        rig = read_json(capture / "rig.json", NominalRigFile, CAPTURE_AGAIN).rig
        sensor = read_json(capture / "sensor.json", SensorFile, CAPTURE_AGAIN).sensor
        if len(sensor.responsivity) != len(rig.lasers):
            raise InputError(
                "is of another number of lasers than rig.json", file=capture / "sensor.json", key="sensor.responsivity",
                value=list(sensor.responsivity), allowed=f"{len(rig.lasers)} values, one for each laser",
                remedy=CAPTURE_AGAIN,
            )  # fmt: skip
        mesh = read_scan(capture / "scan.ply", CAPTURE_AGAIN)
        calibration, calibrated = calibrate(capture, rig, sensor, mesh, given)
        calibration.save(work / "calibration.json")
        mesh = calibration.calibrated(mesh)
        with StreamReader(capture) as stream:
            images = silhouettes_of(stream)
            fit = examine_silhouettes(images, calibration.sensor, rig, mesh, calibration.view_camera)
        for line in fit.warnings():
            log.warning("%s", line)
    samples, statistics = gather(capture, calibration, mesh, settings, stages)
    if statistics.coverage == 0:
        raise InputError("no camera sees any spot's surroundings", file=capture, remedy="check the cameras' poses")
    with stages.stage("surface"):
        samples["footprint"] = subtract_reflection(samples["footprint"])
    save_samples(work / "samples.npz", samples["footprint"])
    with stages.stage("distances"):
        shared = samples["footprint"]  # the methods share its distances
        log.info("%d near pairs", len(shared.spot_pairs.first) + len(shared.vertex_pairs.first))
        left_out = omissions(shared, calibration, calibrated.get("scan", {}).get("left_out"))
    models: dict[str, RelightableModel] = {}
    seconds: dict[str, float] = {}
    for name in settings.methods:
        with stages.stage(f"reconstruct {name}"):
            models[name] = reconstruct(samples[known_methods()[name].reads], name)
            models[name].save(work / f"model-{name}.npz")
        seconds[name] = stages.rows[-1]["seconds"]
        for what, because in models[name].provenance.items():
            if what.startswith(WITHOUT):
                left_out.append({"what": f"{what.removeprefix(WITHOUT)} of {name}", "because": because})
    relit = relight(models, request, work, stages)
    result = {
        "format_version": FORMAT_VERSION,
        "stages": stages.rows,
        "methods": {
            name: {"seconds": seconds[name] + relit[name], "provenance": dict(models[name].provenance)}
            for name in models
        },
        "capture": asdict(statistics),
        "calibration": calibrated,
        "left_out": left_out,
        "warnings": [
            *fit.warnings(),
            *warnings_of(statistics),
            *(
                f"pose: the silhouettes leave open: {text}"
                for text in calibrated.get("silhouettes", {}).get("ambiguity", ())
            ),
        ],
    }
    write_json(work / "pipeline.json", result)
    return result


def calibrate(
    capture: Path, rig: RigConfig, sensor: Sensor, mesh: trimesh.Trimesh, given: Path | None
) -> tuple[Calibration, dict[str, Any]]:
    """From the rig's own images where there are any, else nominal; and what the stages of a measurement found.

    Raises: InputError where the camera is not linear and its response is not known.
    """
    if given is not None:
        known = Calibration.load(given)
        if rig.sensor.response == "curved" and not known.sensor.response:
            raise InputError(
                "the camera is not linear, and this calibration lacks its response",
                file=given,
                key="sensor.response",
                value=list(known.sensor.response),
                remedy="give a calibration of this camera, or none: it is then measured from the targets",
            )
        return known, {"source": "given"}
    if not has_targets(capture, rig):
        if rig.sensor.response == "curved":
            raise InputError(
                "the camera is not linear, and there are no exposures to calibrate it from",
                file=capture / FOLDER,
                key="sensor.response",
                value="curved",
                remedy="photograph the targets",
            )
        return nominal_calibration(rig, sensor), {"source": "nominal"}
    found = measure(capture, rig, sensor, mesh)
    return found.calibration, figures(found)


def warnings_of(statistics: SampleStatistics) -> list[str]:
    """The data's defects, one line each."""
    out = [f"damaged and left out: {address}" for address in statistics.corrupt]
    if statistics.spots_too_oblique:
        out.append(f"{statistics.spots_too_oblique} of {statistics.spots} spots miss the scan or are too oblique")
    if statistics.saturated_pixels:
        out.append(f"{statistics.saturated_pixels} saturated pixels; the entries that they touch are left out")
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m pipeline CAPTURE WORK --request FILE`; 0 on success, 2 after a one-line error."""
    parser = argparse.ArgumentParser(prog="python -m pipeline", description="Reconstruct R_d from a capture, relight.")
    parser.add_argument("capture", type=Path, help="folder with rig.json, sensor.json, scan.ply and the stream")
    parser.add_argument("work", type=Path, help="folder to write into")
    parser.add_argument("--request", type=Path, required=True, help="JSON: reconstruct, relight")
    parser.add_argument("--calibration", type=Path, help="calibration.json of an earlier run; else calibrate")
    parser.add_argument("--until-stdin-closes", action="store_true", help="end at once when the starting process ends")
    options = parser.parse_args(arguments)
    if options.until_stdin_closes:
        threading.Thread(target=_end_with_stdin, daemon=True).start()
    logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(levelname)s %(name)s: %(message)s")
    try:
        request = read_json(options.request, Request, "write it as docs/conventions.md shows")
        run(options.capture, options.work, request, options.calibration)
    except DiscoError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except OSError as error:
        known = refused_by_the_disk(error, options.work)
        if known is None:
            raise
        sys.stderr.write(f"{known}\n")
        return 2
    except MemoryError:
        sys.stderr.write(f"{options.capture}: not enough memory. Remedy: a scan of fewer vertices, or fewer methods\n")
        return 2
    return 0


def _end_with_stdin() -> None:
    """A process that was killed cannot stop the one it started: an orphan would write into the folder of the next."""
    while os.read(0, 1):  # not sys.stdin, whose lock a thread may not hold when Python ends
        pass
    os._exit(1)
