"""`disco-twin run`: from a scene to scores and the report, stage by stage; what is finished is not done again."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from disco_twin.experiment.experiment import Experiment, identity, left_out_by_the_twin
from disco_twin.experiment.pipeline_process import load_results, pipeline_inputs, reconstruct_apart, stale
from disco_twin.experiment.run_folder import RunFolder, content_key, source_key
from disco_twin.run.progress import Report, run_log, stage_bar
from disco_twin.scene.scene import Profile, Scene, load_scene
from hw.base.config import read_json
from hw.base.errors import InputError, refused_by_the_disk
from hw.base.files import write_atomically
from pipeline.capture.loop import Interrupted
from pipeline.reconstruct.registry import known_methods, require_method
from pipeline.records import StageFigures
from pipeline.stream.files import IMAGES, JOURNAL, PLAN
from pipeline.stream.stream import StreamReader

log = logging.getLogger(__name__)

OUTPUTS = {  # files that a finished stage leaves, as patterns in the run folder
    "scan": ("capture/scan.ply", "capture/rig.json", "capture/sensor.json"),
    "targets": ("capture/calibration/*/*", "capture/calibration/*/bracket/*"),
    "capture": ("capture/images.bin", "capture/journal.bin", "capture/plan.json"),
    "truth": ("twin/truth.npz",),
    "references": ("twin/references/*.exr",),
    "pipeline": ("work/pipeline.json", "work/model-*.npz", "work/request.json", "work/relit/*/*.npy"),
    "scores": ("twin/scores.json",),
}
LIGHT_CODE = (  # what the simulated light and the images of it come from
    *(
        f"disco_twin.{part}"
        for part in (
            "object",
            "light",
            "camera",
            "faults",
            "emulation.twin_rig",
            "experiment",
            "scene.materials",
            "run.simulate",
        )
    ),
    *(f"pipeline.{part}" for part in ("plan.spots", "plan.plan", "geometry.camera", "geometry.projector")),
    "hw.record",
)
SCENE_RECORD = "scene.json"  # the scene as it was run: profile applied, file names absolute


@dataclass(frozen=True)
class Run:
    """A scene in its run folder. `scene_file` is where the scene came from (shipped references lie beside it)."""

    experiment: Experiment
    folder: RunFolder
    scene_file: Path
    methods: tuple[str, ...]
    console: Console

    @property
    def scene(self) -> Scene:
        return self.experiment.scene

    def stage(self, name: str, key: str, work: Callable[[Report], Any], unit: str = "") -> None:
        """Do one stage with its progress bar and say what it took; `work` may return its own peak memory in MiB."""

        def watched() -> float | None:
            with stage_bar(self.console, name, unit) as report:
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
        self.console.print(f"  {name:<12} {note}", highlight=False)


def begin_run(
    scene_file: Path, out: Path, profile: Profile, methods: str | None, console: Console, faults: bool | None = None
) -> Run:
    """Read the scene and claim the folder for it."""
    scene = load_scene(scene_file, profile, faults)
    chosen = choose_methods(methods, scene)
    folder = RunFolder.claim(out, scene_file, identity(scene))
    write_atomically(folder.root / SCENE_RECORD, scene.model_dump_json(indent=1).encode())
    return Run(Experiment(scene), folder, scene_file, chosen, console)


def reopen_run(out: Path, methods: str | None, console: Console) -> Run:
    """An existing run folder, to do a part of it again."""
    folder = RunFolder.open(out)
    scene = read_json(out / SCENE_RECORD, Scene, f"disco-twin run SCENE --out {out} writes it anew")
    return Run(Experiment(scene), folder, folder.scene_file, choose_methods(methods, scene), console)


def choose_methods(text: str | None, scene: Scene) -> tuple[str, ...]:
    """`default,disco2004` or `all`, or else the scene's; the cheap baselines are always scored."""
    if text is None:
        chosen = list(scene.reconstruct.methods)
    else:
        chosen = list(known_methods()) if text == "all" else [m.strip() for m in text.split(",") if m.strip()]
    if not chosen:
        raise InputError("names no method", key="--methods", value=text, remedy=f"all, or {', '.join(known_methods())}")
    baselines = [method.name for method in known_methods().values() if method.baseline]
    return tuple(dict.fromkeys([*(require_method(name) for name in chosen), *baselines]))


def light_key(run: Run) -> str:
    """Key of all simulated light: what the scene says, and the code that makes object, light and images of it."""
    return content_key(run.folder.identity, *(source_key(name) for name in LIGHT_CODE))


def drop_old_light(folder: RunFolder, key: str) -> None:
    """Remove light that other code simulated: a stream or a reference would otherwise be continued with the new.

    Nothing is removed from a folder whose light is of this key, or that has none yet.
    """
    marker = folder.twin / "light.key"
    if marker.is_file() and marker.read_text() == key:
        return
    with folder.alone():
        _drop(folder)
        write_atomically(marker, key.encode())


def _drop(folder: RunFolder) -> None:
    old = [] if folder.taken_by_devices else [folder.capture / name for name in (IMAGES, JOURNAL, PLAN)]
    old += [] if folder.taken_by_devices else [*folder.capture.glob("calibration/**/*")]
    old += [*folder.twin.glob("responses/spots-*.npy"), *folder.twin.glob("references/*.exr")]
    old = [path for path in old if path.is_file()]
    if old:
        log.warning("the simulation's code has changed: the light in %s is simulated again", folder.root)
    for path in old:
        path.unlink()


def capture_stages(run: Run) -> None:
    """Scan and capture by the twin. What devices have captured is left as it is, once it is complete."""
    from disco_twin.run import simulate

    if run.folder.taken_by_devices:
        with StreamReader(run.folder.capture) as stream:
            stream.require_complete()
        return
    key = light_key(run)
    drop_old_light(run.folder, key)
    scan_key = content_key(key, run.scene.relight.model_dump_json(include={"views"}))
    run.stage("scan", scan_key, lambda _: simulate.write_scan(run.experiment, run.folder.capture))
    rig = run.scene.rig
    if rig.faults.deviation or rig.sensor.response == "curved":  # else there is nothing that images could tell
        run.stage(
            "targets",
            content_key(key, source_key("pipeline.plan.targets")),
            lambda report: simulate.take_targets(run.experiment, run.folder, report),
            "images",
        )
    run.stage("capture", key, lambda report: simulate.take_images(run.experiment, run.folder, report), "images")


def truth_stages(run: Run) -> None:
    """Ground-truth R_d and the reference images."""
    from disco_twin.experiment.references import reference_key, render_references, shipped_references
    from disco_twin.run import simulate

    scene, folder, key = run.scene, run.folder, light_key(run)
    drop_old_light(folder, key)
    run.stage(
        "truth",
        key,
        lambda report: simulate.compute_truth(run.experiment, folder.twin / "truth.npz", report),
        "columns",
    )
    keys = [reference_key(scene, light, view) for light in scene.relight.lights for view in scene.relight.views]
    shipped = shipped_references(run.scene_file, scene.name)
    run.stage(
        "references",
        content_key(key, keys, scene.simulation.reference_walks),
        lambda report: render_references(run.experiment, shipped, folder.twin / "references", report),
        "lights",
    )


def pipeline_stage(run: Run) -> None:
    """Reconstruct and relight, in a process of its own that is given the capture and nothing of the truth."""
    code = light_key(run), source_key("pipeline"), source_key("hw")
    key = content_key(run.folder.identity, pipeline_inputs(run.scene, run.methods), *code)
    run.stage("pipeline", key, lambda _: reconstruct_apart(run.scene, run.folder, run.methods))
    for warning in load_results(run.folder).warnings:
        log.warning("%s", warning)


def score_stages(run: Run) -> dict[str, Any]:
    """Scores, summary.json and report.html; the summary."""
    from disco_twin.evaluate.scores import load_scores, score_run
    from disco_twin.evaluate.summary import make_summary, write_summary
    from disco_twin.report.collect import collect
    from disco_twin.report.page import write_report

    done = run.folder.stages
    for name in ("capture", "truth", "references", "pipeline"):
        if name not in done or not done[name].finished:
            raise InputError(
                f"the stage {name} is not finished",
                file=run.folder.root,
                remedy=f"disco-twin run {run.scene_file} --out {run.folder.root}",
            )
    if why := stale(run.scene, run.folder, run.methods):
        remedy = f"disco-twin reconstruct --out {run.folder.root} --methods {','.join(run.methods)}"
        raise InputError(why, file=run.folder.work, key="--methods", value=",".join(run.methods), remedy=remedy)
    key = content_key(
        *(done[name].key for name in ("truth", "references", "pipeline")),
        list(run.methods),
        source_key("disco_twin.evaluate.scores"),
        source_key("pipeline.relight.scores"),
    )
    run.stage("scores", key, lambda _: score_run(run.experiment, run.folder, run.methods))
    made = load_results(run.folder)
    left_out = [*left_out_by_the_twin(run.experiment), *made.left_out]
    stages, scores = stage_rows(run.folder, made.stages), load_scores(run.folder)
    summary = make_summary(run.scene, run.folder, run.methods[0], stages, scores, made.calibration, left_out)
    write_summary(summary, run.folder.summary_file)
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
    """Everything, from the scan to the report."""
    with run_log(run.folder.root / "run.log", run.console):
        capture_stages(run)
        truth_stages(run)
        pipeline_stage(run)
        return score_stages(run)


def print_scores(summary: dict[str, Any], methods: Sequence[str], console: Console) -> None:
    """A table of nrmse by light and method."""
    from rich.table import Table

    from disco_twin.evaluate.summary import figure_or_dash, pooled

    relit = summary["relit"]
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("nrmse")
    for method in methods:
        table.add_column(method, justify="right")
    for light in dict.fromkeys(r["light"] for r in relit):
        table.add_row(light, *(figure_or_dash(pooled(relit, method, light)) for method in methods))
    console.print()
    console.print(table)


def print_budget(rows: Sequence[dict[str, Any]], console: Console) -> None:
    """A table of nrmse by light and calibration."""
    from rich.table import Table

    from disco_twin.evaluate.summary import figure_or_dash, rms

    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("nrmse, calibration")
    lights = list(dict.fromkeys(row["light"] for row in rows))
    for light in lights:
        table.add_column(light, justify="right")
    for name in dict.fromkeys(row["calibration"] for row in rows):
        own = [row for row in rows if row["calibration"] == name]
        kept = {x: [r["nrmse"] for r in own if r["light"] == x and r["nrmse"] is not None] for x in lights}
        table.add_row(name, *(figure_or_dash(rms(kept[x]) if kept[x] else None) for x in lights))
    console.print()
    console.print(table)
