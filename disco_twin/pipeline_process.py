"""Runs the pipeline as a process of its own: it is given the capture and a folder to work in, and nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any

from disco_twin.folder import RunFolder, write_atomically
from disco_twin.scene import Scene
from hw.errors import DiscoError


class PipelineFailed(DiscoError):
    """The pipeline's process ended with an error; the message is its own last line."""


def pipeline_inputs(scene: Scene, methods: Sequence[str]) -> dict[str, Any]:
    """What the pipeline is asked to do: settings, methods, and what to relight. Written as WORK/request.json."""
    return {
        "format_version": 1,
        "reconstruct": scene.reconstruct.model_copy(update={"methods": tuple(methods)}).model_dump(mode="json"),
        "relight": scene.relight.model_dump(mode="json"),
    }


def reconstruct_apart(scene: Scene, folder: RunFolder, methods: Sequence[str]) -> float:
    """Run `python -m pipeline` on the capture; its peak memory in MiB. Its messages go to OUT/work/pipeline.log.

    The peak is the process's own word: `wait4` would count what our process held when it started the child.
    """
    request = folder.work / "request.json"
    write_atomically(request, json.dumps(pipeline_inputs(scene, methods), indent=1).encode())
    command = [sys.executable, "-m", "pipeline", str(folder.capture), str(folder.work), "--request", str(request)]
    with tempfile.TemporaryFile("w+") as errors:
        with (folder.work / "pipeline.log").open("w") as log:
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=errors)
            try:
                status = child.wait()
            except BaseException:
                child.terminate()
                child.wait()
                raise
        errors.seek(0)
        said = errors.read().strip().splitlines()
    if status != 0:
        why = said[-1] if said else f"ended with status {status}"
        raise PipelineFailed(why if status == 2 else f"the pipeline failed: {why}")
    made = json.loads((folder.work / "pipeline.json").read_text())
    return max(float(row["peak_mb"]) for row in made["stages"])
