"""Makes the rows of an error budget that are not there yet, and keeps them in OUT/twin/budget.json.

Rows that share their photons or their pipeline are made together, as a group; what is finished is not made again. Each
group shows a bar while it is made, and a line when it is there.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from disco_twin.evaluate.exact_light import SAMPLE_WALKS
from disco_twin.evaluate.scores import reference_halves
from disco_twin.evaluate.true_calibration import VARIANTS
from disco_twin.experiment.pipeline_process import stale
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.run.budget.job_rows import JobRows
from disco_twin.run.budget.light_rows import LightRows
from disco_twin.run.budget.rows import EXACT_SCAN, NOMINAL, QUIET, Budget, BudgetRow, Images
from disco_twin.run.progress import Report, stage_bar
from disco_twin.run.stages import Run
from hw.base.config import Strict, read_json
from hw.base.errors import InputError
from hw.base.files import write_json
from pipeline.calibrate.calibration import Calibration
from pipeline.capture.loop import Interrupted
from pipeline.geometry.fresnel import Boundary
from pipeline.relight.scores import Unscorable, score_halves

log = logging.getLogger(__name__)

FORMAT_VERSION = 3
RECORD = "budget.json"
WALKS = 4_000_000  # of a light, both halves together
ENDS = "ends"  # the group that the floor's curve comes from


class _Curve(Strict):
    """A boundary's ratio to the smooth one."""

    eta: float
    cosines: tuple[float, ...]
    ratio: tuple[float, ...]


class _Kept(Strict):
    """The rows of a group, and the key of all that they depend on. curve: the floor's, of the group `ENDS`."""

    key: str
    rows: tuple[BudgetRow, ...]
    curve: _Curve | None = None


class _Record(Strict):
    """OUT/twin/budget.json."""

    format_version: Literal[3]
    groups: dict[str, _Kept]


@dataclass(frozen=True)
class _Group:
    """Rows that are made together. inputs: what they depend on beside object, rig, references and code.

    make: the floor's curve -> the rows, and a new curve of the floor where they have one; it reports its photons
    """

    inputs: tuple[Any, ...]
    make: Callable[[Boundary, Report], tuple[Mapping[str, Images], Boundary | None]]


def make_budget(run: Run, walks: int = WALKS) -> Budget:
    """All rows of a finished run, for the first of its methods; what is there under the same key is not made again.
    Needs the renderer.

    walks: photons of a light. Raises: InputError where a stage of the run is not finished, or the reconstruction is of
    other settings; Interrupted at Ctrl-C; DiscoError where another process works in the folder.
    """
    require_finished(run)
    groups, left_out = _groups(run, walks)
    with run.folder.alone():
        kept = _kept_groups(run.folder)
        references = run.folder.stages["references"].key
        try:
            for number, (name, group) in enumerate(groups.items(), 1):
                key, start = run.key("budget", references, *group.inputs), time.perf_counter()
                note = "made before"
                if name not in kept or kept[name].key != key:
                    curve = kept[ENDS].curve if ENDS in kept else None
                    with stage_bar(run.console, name, "photons") as report:
                        rows, found = group.make(_boundary(run, curve), report)
                    kept[name] = _Kept(key=key, rows=_scored(run, rows), curve=_written(found))
                    record = {"format_version": FORMAT_VERSION, "groups": {k: g.model_dump() for k, g in kept.items()}}
                    write_json(run.folder.twin / RECORD, record)
                    note = f"{time.perf_counter() - start:.1f} s"
                run.console.print(f"  {f'{number}/{len(groups)} {name}':<32} {note:>12}", highlight=False)
        except KeyboardInterrupt:
            raise Interrupted("stopped during budget; the same command continues") from None
    return Budget(tuple(row for name in groups for row in kept[name].rows), left_out)


def require_finished(run: Run) -> None:
    """Raises: InputError where the run has no references or nothing that was relit, or that is of other settings."""
    done = run.folder.stages
    for name in ("references", "pipeline"):
        if name not in done or not done[name].finished:
            remedy = f"disco-twin run {run.scene_file} --out {run.folder.root}"
            raise InputError(f"the stage {name} is not finished", file=run.folder.root, remedy=remedy)
    method = run.methods[0]
    if why := stale(run.scene, run.folder, (method,)):
        remedy = f"disco-twin reconstruct --out {run.folder.root} --methods {method}"
        raise InputError(why, file=run.folder.work, key="--method", value=method, remedy=remedy)


def _groups(run: Run, walks: int) -> tuple[dict[str, _Group], dict[str, str]]:
    """What can be made exact in a run, the floor's curve first of all that needs it; what is left out, and why."""
    light, jobs = LightRows(run, walks), JobRows(run, run.methods[0], run.folder.twin / "budget")
    lit = (walks, run.scene.reconstruct.eta, run.scene.relight.model_dump(mode="json"))
    job = (run.folder.stages["pipeline"].key, run.methods[0])

    def of_light(work: Callable[[Boundary], tuple[Mapping[str, Images], Boundary | None]]) -> _Group:
        def counted(curve: Boundary, report: Report) -> tuple[Mapping[str, Images], Boundary | None]:
            light.count(report, walks * len(run.scene.relight.lights))
            return work(curve)

        return _Group(lit, counted)

    def of_samples(curve: Boundary, report: Report) -> tuple[Mapping[str, Images], None]:
        light.count(report, SAMPLE_WALKS * len(run.experiment.plan.spots))
        return jobs.exact_samples(light.exact, curve), None

    def of_job(work: Callable[[], Mapping[str, Images]]) -> _Group:
        return _Group(job, lambda curve, report: (work(), None))

    groups = {
        "entry": of_light(lambda _: (light.exact_entry(), None)),
        ENDS: of_light(lambda _: light.diffuse_ends()),
        "hats": of_light(lambda curve: (light.true_model(curve), None)),
        "samples": _Group((*lit, *job), of_samples),
        "measured": of_job(jobs.measured),
    }
    left_out: dict[str, str] = {}
    own = Calibration.load(run.folder.work / "calibration.json")
    if own.source == "measured":
        groups |= {name: of_job(partial(jobs.recalibrated, own, name)) for name in (NOMINAL, *VARIANTS)}
    else:
        left_out["calibration"] = "it was not measured: there is nothing to make true"
    if run.folder.taken_by_devices:
        return groups, left_out | dict.fromkeys(["the scanner", "camera noise"], "devices took these images")
    if run.scene.rig.faults.scanner:
        groups[EXACT_SCAN] = of_job(jobs.exact_scan)
    else:
        left_out["the scanner"] = "it has no error here (rig.faults.scanner)"
    groups[QUIET] = of_job(jobs.quiet_camera)
    return groups, left_out


def _kept_groups(folder: RunFolder) -> dict[str, _Kept]:
    path = folder.twin / RECORD
    return dict(read_json(path, _Record, "delete it, then repeat the command").groups) if path.is_file() else {}


def _boundary(run: Run, kept: _Curve | None) -> Boundary:
    """The floor's curve; the smooth boundary before there is one."""
    return Boundary(run.scene.reconstruct.eta) if kept is None else Boundary(kept.eta, kept.cosines, kept.ratio)


def _written(curve: Boundary | None) -> _Curve | None:
    return None if curve is None else _Curve(eta=curve.eta, cosines=curve.cosines, ratio=curve.ratio)


def _scored(run: Run, rows: Mapping[str, Images]) -> tuple[BudgetRow, ...]:
    """Every image of these rows against its reference, without the object's rim."""
    out, relight = [], run.scene.relight
    masks = {view.name: run.experiment.object_pixels(view).inner for view in relight.views}
    for light in relight.lights:
        for view in relight.views:
            halves = reference_halves(run.folder, light, view)
            for row, images in rows.items():
                figures: dict[str, float | None] = {"nrmse": None, "nrmse_se": None}
                try:
                    score = score_halves(images[light.name, view.name], halves, masks[view.name])
                    figures = {"nrmse": score.nrmse, "nrmse_se": score.nrmse_se}
                except Unscorable as why:
                    log.warning("no score for %s of %s in %s: %s", row, light.name, view.name, why)
                out.append(BudgetRow(row=row, light=light.name, view=view.name, **figures))
    return tuple(out)
