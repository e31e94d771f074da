"""`disco-twin run`: from a scene to scores and the report, stage by stage; what is finished is not done again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import code_key, content_key, identity
from disco_twin.experiment.omissions import left_out_by_the_twin
from disco_twin.experiment.pipeline_process import load_results, pipeline_inputs, reconstruct_apart, stale
from disco_twin.experiment.references import (
    outside_folder,
    reference_key,
    reference_path,
    render_references,
    shipped_references,
)
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.run.progress import Report, run_log, stage_bar
from disco_twin.run.time_left import TimeLeft, in_words
from disco_twin.scene.scene import Profile, Scene, load_scene
from hw.base.errors import InputError, refused_by_the_disk
from hw.base.files import write_atomically, write_json
from pipeline.capture.loop import Interrupted
from pipeline.capture.poses import pose_warnings
from pipeline.reconstruct.registry import known_methods, require_method
from pipeline.records import StageFigures
from pipeline.stream.files import IMAGES
from pipeline.stream.stream import StreamReader

log = logging.getLogger(__name__)

CODE = {  # where the code of a stage begins: all that it imports is part of the stage's key
    "scan": ("disco_twin.run.scan",),
    "targets": ("disco_twin.run.targets",),
    "spots": ("disco_twin.light.response",),
    "capture": ("disco_twin.run.simulate",),
    "truth": ("disco_twin.experiment.ground_truth",),
    "references": ("disco_twin.experiment.references",),
    "pipeline": ("pipeline.__main__", "pipeline.reconstruct"),  # methods are found in their files, not imported
    "scores": ("disco_twin.evaluate.scores",),
    "budget": ("disco_twin.run.budget", "pipeline.reconstruct"),
}
CAPTURE = ("capture/images.bin", "capture/journal.bin", "capture/plan.json")
TARGETS = ("capture/calibration/*/*", "capture/calibration/*/bracket/*")
REFERENCES = ("twin/references/*.exr", "twin/references/volpath/*.exr")
OUTPUTS = {  # files that a finished stage leaves, as patterns in the run folder
    "scan": ("capture/scan.ply", "capture/rig.json", "capture/sensor.json"),
    "targets": TARGETS,
    "capture": CAPTURE,
    "truth": ("twin/truth.npz", "twin/moments.npz"),
    "references": REFERENCES,
    "pipeline": (
        *(f"work/{name}" for name in ("pipeline.json", "request.json", "calibration.json", "samples.npz")),
        "work/model-*.npz",
        "work/relit*/*/*.npy",
    ),
    "scores": ("twin/scores.json",),
}
CONTINUED = {  # files that interrupted work is continued from
    "targets": TARGETS,
    "spots": ("twin/responses/spots-*.npy",),
    "capture": (*CAPTURE, "twin/light.key"),  # the last one: of earlier versions
    "references": REFERENCES,
}


@dataclass(frozen=True)
class Run:
    """A scene in its run folder. `scene_file` is where the scene came from (shipped references lie beside it)."""

    experiment: Experiment
    folder: RunFolder
    scene_file: Path
    methods: tuple[str, ...]
    console: Console
    time_left: TimeLeft | None = None  # of a whole run

    @property
    def scene(self) -> Scene:
        return self.experiment.scene

    def key(self, stage: str, *inputs: Any) -> str:
        """Key of a stage: what the scene states of rig and object, the stage's code, its other inputs.

        Raises: InputError as `code_key`.
        """
        return content_key(self.folder.identity, code_key(*CODE[stage]), *inputs)

    def stage(self, name: str, key: str, work: Callable[[Report], Any], unit: str = "") -> None:
        """Do one stage with its progress bar and print what it took; `work` may return its own peak memory in MiB.

        Raises: Interrupted at Ctrl-C, DiscoError where the disk refuses, and what `work` raises.
        """

        left, start = self.time_left, time.perf_counter()

        def whole(of_it: float | None) -> str:
            assert left is not None
            if of_it is None:
                of_it = max(left.pace * left.expected[name] - (time.perf_counter() - start), 0.0)
            return f"whole {in_words(left.seconds(name, of_it))}"

        def watched() -> float | None:
            with stage_bar(self.console, name, unit, None if left is None else whole) as report:
                peak = work(report)
            return peak if isinstance(peak, float) else None

        try:
            done = self.folder.run(name, key, watched, OUTPUTS.get(name, ()))
        except KeyboardInterrupt:
            raise Interrupted(f"stopped during {name}; the same command continues") from None
        except OSError as error:
            raise refused_by_the_disk(error, self.folder.root) or error from error
        record = self.folder.stages[name]
        note = f"{record.seconds:8.1f} s {record.peak_mb:8.0f} MiB" if done else "finished before"
        if left is not None:
            left.finished(name, time.perf_counter() - start if done else None)
            note += f"   about {in_words(seconds)} left" if done and (seconds := left.seconds()) > 5 else ""
        self.console.print(f"  {name:<12} {note}", highlight=False)


def begin_run(
    scene_file: Path, out: Path, profile: Profile, methods: str | None, console: Console, faults: bool | None = None
) -> Run:
    """Read the scene and claim the folder for it. Raises: InputError for either."""
    scene = load_scene(scene_file, profile, faults)
    chosen = choose_methods(methods, scene)
    folder = RunFolder.claim(out, scene_file, identity(scene))
    folder.write_scene(scene)
    return Run(Experiment(scene), folder, scene_file, chosen, console)


def reopen_run(out: Path, methods: str | None, console: Console) -> Run:
    """An existing run folder, to do a part of it again. Raises: InputError where it is none."""
    folder = RunFolder.open(out)
    scene = folder.read_scene()
    return Run(Experiment(scene), folder, folder.scene_file, choose_methods(methods, scene), console)


def choose_methods(text: str | None, scene: Scene) -> tuple[str, ...]:
    """`default,disco2004` or `all`, or else the scene's; the cheap baselines are always scored.

    Raises: InputError for an unknown method.
    """
    if text is None:
        chosen = list(scene.reconstruct.methods)
    else:
        chosen = list(known_methods()) if text == "all" else [m.strip() for m in text.split(",") if m.strip()]
    if not chosen:
        raise InputError("names no method", key="--methods", value=text, remedy=f"all, or {', '.join(known_methods())}")
    baselines = [method.name for method in known_methods().values() if method.baseline]
    return tuple(dict.fromkeys([*(require_method(name) for name in chosen), *baselines]))


def drop_outdated(folder: RunFolder, stage: str, key: str) -> None:
    """Remove what other code left of an interrupted stage: it would otherwise be continued with the new.

    Nothing is removed where the stage has left nothing yet, or was begun under this key (OUT/twin/<stage>.key).
    """
    marker = folder.twin / f"{stage}.key"
    if marker.is_file() and marker.read_text() == key:
        return
    with folder.alone():
        old = [path for pattern in CONTINUED[stage] for path in folder.root.glob(pattern) if path.is_file()]
        if old:
            log.warning("the code or renderer has changed: what it left of %s in %s is made again", stage, folder.root)
        for path in old:
            path.unlink()
        write_atomically(marker, key.encode())


def capture_stages(run: Run) -> None:
    """Scan and capture by the twin. What devices have captured is left as it is. Raises: InputError if it is cut."""
    for warning in run.experiment.warnings:
        log.warning("%s", warning)
    if run.folder.taken_by_devices:
        with StreamReader(run.folder.capture) as stream:
            stream.require_complete()
        return
    from disco_twin.run.scan import write_scan
    from disco_twin.run.simulate import take_images
    from disco_twin.run.targets import take_targets

    experiment, folder, scene = run.experiment, run.folder, run.scene
    for name in ("targets", "spots", "capture"):
        drop_outdated(folder, name, run.key(name))
    views = scene.relight.model_dump_json(include={"views"})
    run.stage("scan", run.key("scan", views), lambda _: write_scan(experiment, folder.capture))
    if scene.rig.faults.deviation or scene.rig.sensor.response == "curved":  # else images of targets show nothing new
        run.stage("targets", run.key("targets"), lambda report: take_targets(scene, folder.capture, report), "images")
    take = partial(take_images, experiment, folder.capture, folder.twin / "responses")
    run.stage("capture", run.key("capture"), take, "images")
    for warning in pose_warnings(folder.capture):
        log.warning("%s", warning)


def truth_stages(run: Run) -> None:
    """Ground-truth R_d, its angular moments, and the reference images."""
    from disco_twin.experiment.ground_truth import compute_truth

    experiment, scene, folder = run.experiment, run.scene, run.folder
    run.stage("truth", run.key("truth"), lambda report: compute_truth(experiment, folder.twin, report), "columns")
    drop_outdated(folder, "references", run.key("references"))
    keys = [reference_key(scene, light, view) for light in scene.relight.lights for view in scene.relight.views]
    shipped = shipped_references(run.scene_file, scene.name)
    render = partial(render_references, experiment, shipped, folder.twin / "references")
    outside = sorted(outside_folder(shipped).glob("*.exr"))
    key = run.key("references", keys, scene.simulation.reference_noise, outside)
    run.stage("references", key, render, "lights")


def pipeline_key(run: Run, methods: Sequence[str]) -> str:
    """Key of a reconstruction by these methods of the capture as it is now."""
    done = run.folder.stages
    capture: list[Any] = [done[name].key for name in ("scan", "targets", "capture") if name in done]
    if run.folder.taken_by_devices:  # by their content: they may be taken anew, or added to; journals hold checksums
        found, own = sorted(run.folder.capture.rglob("*")), run.folder.capture
        capture += [{str(path.relative_to(own)): path} for path in found if path.is_file() and path.name != IMAGES]
    return run.key("pipeline", capture, pipeline_inputs(run.scene, methods))


def still_made(run: Run) -> tuple[str, ...]:
    """Methods whose models the latest reconstruct left, if it was of the capture, the code and the settings of now."""
    record = run.folder.stages.get("pipeline")
    if record is None or not record.finished or not (run.folder.work / "pipeline.json").is_file():
        return ()
    made = tuple(load_results(run.folder).methods)
    return made if record.key == pipeline_key(run, made) else ()


def pipeline_stage(run: Run) -> None:
    """Reconstruct and relight, in a process of its own that is given the capture and nothing of the truth.

    Methods that were made before of this capture, by this code and these settings, stay.

    Raises: PipelineFailed with its last line, and what `Run.stage` raises.
    """
    made = still_made(run)
    kept = made if made and run.folder.stages["pipeline"].damaged(run.folder.root) is None else ()
    methods = tuple(dict.fromkeys([*made, *run.methods]))
    asked = [method for method in methods if method not in kept]
    key = pipeline_key(run, methods)
    run.stage("pipeline", key, lambda _: reconstruct_apart(run.scene, run.folder, asked, kept=kept))
    for warning in load_results(run.folder).warnings:
        log.warning("%s", warning)


def score_stages(run: Run) -> dict[str, Any]:
    """Scores, summary.json and report.html of all methods that were made, the run's own first; the summary.

    Raises: InputError where a stage before is not finished, or the reconstruction is of other settings.
    """
    from disco_twin.evaluate.scores import load_scores, score_run
    from disco_twin.evaluate.summary import make_summary
    from disco_twin.report.collect import collect
    from disco_twin.report.page import write_report

    done = run.folder.stages
    again = f"disco-twin run {run.scene_file} --out {run.folder.root}"
    for name in ("capture", "truth", "references", "pipeline"):
        if name not in done or not done[name].finished:
            raise InputError(f"the stage {name} is not finished", file=run.folder.root, remedy=again)
    if why := stale(run.scene, run.folder, run.methods):
        remedy = f"disco-twin reconstruct --out {run.folder.root} --methods {','.join(run.methods)}"
        raise InputError(why, file=run.folder.work, key="--methods", value=",".join(run.methods), remedy=remedy)
    if done["pipeline"].key != pipeline_key(run, tuple(load_results(run.folder).methods)):
        remedy = f"disco-twin reconstruct --out {run.folder.root}"
        log.warning(
            "the capture, or the pipeline's code, has changed since the latest reconstruct; `%s` repeats it", remedy
        )
    if done["truth"].key != run.key("truth"):
        log.warning("the code of the ground truth has changed since it was computed; `%s` computes it again", again)
    neck = run.scene.relight.model_dump_json(include={"neck"})
    made = load_results(run.folder)
    methods = list(dict.fromkeys([*run.methods, *made.methods]))
    key = run.key("scores", *(done[name].key for name in ("truth", "references", "pipeline")), methods, neck)
    run.stage("scores", key, lambda _: score_run(run.experiment, run.folder, methods))
    left_out = [*left_out_by_the_twin(run.experiment), *made.left_out]
    stages, scores = stage_rows(run.folder, made.stages), load_scores(run.folder)
    summary = make_summary(run.scene, run.folder, run.methods[0], stages, scores, made.calibration, left_out)
    write_json(run.folder.summary_file, summary)
    write_report(collect(run.experiment, run.folder, summary), run.folder.report_file)
    return summary


def stage_rows(folder: RunFolder, parts: Sequence[StageFigures]) -> list[dict[str, Any]]:
    """Rows {name, seconds, peak_mb} in the order of the work; the pipeline's process is shown by its parts."""
    rows: list[dict[str, Any]] = []
    for stage in folder.stages.values():
        if stage.name != "pipeline":
            rows.append({"name": stage.name, "seconds": stage.seconds, "peak_mb": stage.peak_mb})
            continue
        start = max(stage.seconds - sum(p.seconds for p in parts), 0.0)
        lowest = min((p.peak_mb for p in parts), default=stage.peak_mb)
        rows.append({"name": "start the pipeline", "seconds": start, "peak_mb": lowest})
        rows.extend(p.model_dump() for p in parts)
    return rows


def run_all(run: Run) -> dict[str, Any]:
    """Everything, from the scan to the report. Raises: what the stages raise."""
    shipped, relight, made = shipped_references(run.scene_file, run.scene.name), run.scene.relight, run.folder.twin
    places = (shipped, made / "references")
    missing = [
        light
        for light in relight.lights
        if not all(any(reference_path(at, light, view).is_file() for at in places) for view in relight.views)
    ]
    run = replace(run, time_left=TimeLeft(run.scene, len(missing)))
    with run_log(run.folder.root / "run.log", run.console):
        capture_stages(run)
        truth_stages(run)
        pipeline_stage(run)
        return score_stages(run)
