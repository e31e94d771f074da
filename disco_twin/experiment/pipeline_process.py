"""Runs the pipeline as a process of its own: it is given the capture and a folder to work in, and nothing else."""

from __future__ import annotations

import json
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from disco_twin.experiment.run_folder import RunFolder
from disco_twin.scene.scene import Scene
from hw.base.children import child_environment, module_command
from hw.base.config import read_json
from hw.base.errors import DiscoError
from hw.base.files import write_json
from pipeline.records import PipelineRecord

REQUEST = "request.json"


class PipelineFailed(DiscoError):
    """The pipeline's process ended with an error; the message is its own last line."""


def pipeline_inputs(scene: Scene, methods: Sequence[str]) -> dict[str, Any]:
    """What the pipeline is asked to do: settings, methods, and what to relight. Written as WORK/request.json."""
    return {
        "format_version": 1,
        "reconstruct": scene.reconstruct.model_copy(update={"methods": tuple(methods)}).model_dump(mode="json"),
        "relight": scene.relight.model_dump(mode="json", include={"views", "lights"}),
    }


def reconstruct_apart(
    scene: Scene, folder: RunFolder, methods: Sequence[str], calibration: Path | None = None, kept: Sequence[str] = ()
) -> float:
    """Run `python -m pipeline` on the capture; its peak memory in MiB. Its messages go to OUT/work/pipeline.log.

    calibration: a file to use instead of what the pipeline would calibrate itself; kept: methods of the latest record
    that stay in it, since their models still hold.
    The process reports its peak itself: `wait4` would count what our process held when it started the child.

    Raises: PipelineFailed with the process's own last line.
    """
    request, before = folder.work / REQUEST, _record(folder) if kept else {}
    write_json(request, pipeline_inputs(scene, methods))
    options = ["--until-stdin-closes", *(() if calibration is None else ("--calibration", str(calibration)))]
    paths = str(folder.capture), str(folder.work), "--request", str(request)
    command = module_command("pipeline", *paths, *options)
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        with (
            (folder.work / "pipeline.log").open("wb") as log,
            subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=errors, env=child_environment()
            ) as child,
        ):
            try:
                status = child.wait()
            except BaseException:
                child.terminate()
                raise
        errors.seek(0)
        lines = errors.read().strip().splitlines()
    if status != 0:
        why = lines[-1] if lines else f"ended with status {status}"
        if status == -signal.SIGKILL:
            remedy = "a scan of fewer vertices (scan.vertices), fewer methods, or a machine with more memory"
            raise PipelineFailed(f"{folder.capture}: the pipeline was killed, most likely for memory. Remedy: {remedy}")
        if status == 2:
            raise PipelineFailed(why)
        remedy = f"see {folder.work / 'pipeline.log'}, and report it with that file"
        raise PipelineFailed(f"the pipeline failed: {why}. Remedy: {remedy}")
    if kept:
        _keep(scene, folder, before, kept)
    return max(row.peak_mb for row in load_results(folder).stages)


def _record(folder: RunFolder) -> dict[str, Any]:
    """pipeline.json as it stands."""
    return read_json(folder.work / "pipeline.json", dict[str, Any], f"disco-twin reconstruct --out {folder.root}")


def _keep(scene: Scene, folder: RunFolder, before: dict[str, Any], kept: Sequence[str]) -> None:
    """Write the record, and the request, of what was made now and of the methods that stay from before."""
    now = _record(folder)
    own = {method: before["methods"][method] for method in kept}
    theirs = [row for row in before["left_out"] if any(row["what"].endswith(f" of {method}") for method in kept)]
    now["left_out"] += [row for row in theirs if row not in now["left_out"]]
    now["methods"] = own | now["methods"]
    write_json(folder.work / "pipeline.json", now)
    write_json(folder.work / REQUEST, pipeline_inputs(scene, tuple(now["methods"])))


def load_results(folder: RunFolder) -> PipelineRecord:
    """What the pipeline's process wrote about its work. Raises: InputError where that cannot be read."""
    path = folder.work / "pipeline.json"
    return read_json(path, PipelineRecord, f"delete it, then disco-twin reconstruct --out {folder.root}")


def stale(scene: Scene, folder: RunFolder, methods: Sequence[str]) -> str | None:
    """Why the latest reconstruction is not what these methods of this scene would be scored by; None if it is.

    Raises: InputError where the records of the latest one cannot be read.
    """
    made = load_results(folder).methods
    missing = [method for method in methods if method not in made]
    if missing:
        return f"the latest reconstruct did not make {', '.join(missing)}, only {', '.join(made)}"
    asked = read_json(folder.work / REQUEST, dict[str, Any], f"disco-twin reconstruct --out {folder.root}")
    if asked != json.loads(json.dumps(pipeline_inputs(scene, tuple(made)))):
        return "the scene's [reconstruct] or [relight] has changed since the latest reconstruct"
    return None
