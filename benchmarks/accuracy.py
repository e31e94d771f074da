"""How well every method relights objects that none of its constants was chosen on, beside all baselines, in pairs.

    python -m benchmarks accuracy --json FILE          the objects to score on, and quick
    python -m benchmarks accuracy-choose --json FILE   those that constants may be chosen on

objects     nrmse by object, method and light: the root of the mean over the views of their signed squares
views       the same by view
mean        by method and light, over the objects of the set alone (quick's figures stand beside it); of those
            that did not fail
paired      rows of the default against each baseline: the difference of nrmse2, default less baseline (negative: the
            default is better), mean over the views, on the same reference halves and pixels; its standard error from
            their noise
lost        the rows in which a baseline is better by more than three standard errors
seconds     of reconstruction and relighting by object and method; memory: peak MiB of the reconstruction
wall_s      of the whole command: little where captures are there; `stages` says what each stage took when it was done
failed      objects that could not be run, and why; the others are not lost

Each object is a whole run in out/accuracy/<name>, as `disco-twin run` does it: what is finished there is not done
again, and its report lies there. docs/accuracy.md says which constant was chosen on what.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from disco_twin.evaluate.scores import load_relit, reference_halves
from disco_twin.evaluate.summary import pooled
from disco_twin.experiment.pipeline_process import load_results
from disco_twin.run.stages import Run, begin_run, run_all
from disco_twin.scene.scene import Profile
from hw.base.errors import DiscoError
from pipeline.capture.loop import Interrupted
from pipeline.relight.scores import Unscorable, paired_difference

log = logging.getLogger(__name__)

REPOSITORY = Path(__file__).resolve().parents[1]
SCENES = REPOSITORY / "scenes"
RUNS = REPOSITORY / "out" / "accuracy"
QUICK_OBJECT, QUICK_LIGHTS = "bracket", '["uniform", "directional"]'  # what --quick runs, in the small profile
METHOD = "default"
LOST = 3.0  # standard errors


def run(quick: bool = False) -> dict[str, Any]:
    """The scoring set and quick; `quick`: one object of it, shrunken, under two lights."""
    if quick:
        return shrunken(SCENES / "accuracy" / "score" / f"{QUICK_OBJECT}.toml")
    return report([*set_of("score"), SCENES / "quick.toml"], RUNS, beside=("quick",))


def set_of(name: str) -> list[Path]:
    """The scenes of a set, `choose` or `score`."""
    return sorted((SCENES / "accuracy" / name).glob("*.toml"))


def shrunken(scene: Path) -> dict[str, Any]:
    """The record of one object in the small profile, under two lights; its scene file lies beside its run."""
    folder = RUNS / "small"
    folder.mkdir(parents=True, exist_ok=True)
    views = "[[relight.views]]"
    text = scene.read_text().replace(views, f"[relight]\nlights = {QUICK_LIGHTS}\n\n{views}", 1)
    (folder / scene.name).write_text(text)
    return report([folder / scene.name], folder, "small")


def report(scenes: Sequence[Path], runs: Path, profile: Profile = "full", beside: Iterable[str] = ()) -> dict[str, Any]:
    """Run all scenes and put their figures together; `beside`: objects that do not count in the mean."""
    made: dict[str, dict[str, Any]] = {}
    failed, start = [], time.perf_counter()
    for scene in scenes:
        try:
            made[scene.stem] = object_figures(scene, runs / scene.stem, profile)
        except Interrupted:
            raise
        except DiscoError as error:
            failed.append({"object": scene.stem, "because": str(error)})
        except Exception as error:
            log.exception("%s failed", scene.stem)
            failed.append({"object": scene.stem, "because": f"{type(error).__name__}: {error}"})
    paired = [row for figures in made.values() for row in figures["paired"]]
    return {
        "objects": {name: figures["nrmse"] for name, figures in made.items()},
        "views": {name: figures["views"] for name, figures in made.items()},
        "mean": means([made[name]["nrmse"] for name in made if name not in set(beside)]),
        "paired": paired,
        "lost": [row for row in paired if row["difference"] > LOST * row["standard_error"]],
        "seconds": {name: figures["seconds"] for name, figures in made.items()},
        "memory": {name: figures["memory"] for name, figures in made.items()},
        "stages": {name: figures["stages"] for name, figures in made.items()},
        "wall_s": time.perf_counter() - start,
        "failed": failed,
    }


def object_figures(scene: Path, folder: Path, profile: Profile) -> dict[str, Any]:
    """One object's run, and what the record holds of it."""
    opened = begin_run(scene, folder, profile, "all", Console(stderr=True))
    summary = run_all(opened)
    relit = summary["relit"]
    lights = list(dict.fromkeys(row["light"] for row in relit))
    views = list(dict.fromkeys(row["view"] for row in relit))
    by_place = {(row["method"], row["light"], row["view"]): row["nrmse"] for row in relit}
    peaks = {row["name"]: row["peak_mb"] for row in summary["stages"]}
    results = load_results(opened.folder).methods
    return {
        "nrmse": {m: {x: _number(pooled(relit, m, x)) for x in lights} for m in opened.methods},
        "views": {m: {x: {v: by_place[m, x, v] for v in views} for x in lights} for m in opened.methods},
        "paired": paired_rows(opened),
        "seconds": {method: results[method].seconds for method in opened.methods},
        "memory": {method: peaks[f"reconstruct {method}"] for method in opened.methods},
        "stages": {row["name"]: row["seconds"] for row in summary["stages"]},
    }


def paired_rows(opened: Run) -> list[dict[str, Any]]:
    """Rows {object, light, baseline, difference, standard_error}: the default against every other method.

    One walk may serve both views, so their errors are taken as alike: no standard error of the mean is larger.
    """
    folder, relight = opened.folder, opened.scene.relight
    masks = {view.name: opened.experiment.object_pixels(view).inner for view in relight.views}
    rows = []
    for light in relight.lights:
        for baseline in (method for method in opened.methods if method != METHOD):
            pairs = []
            for view in relight.views:
                own, other = (load_relit(folder, method, light.name, view) for method in (METHOD, baseline))
                a, b = reference_halves(folder, light, view)
                try:
                    pairs.append(paired_difference(own, other, a, b, masks[view.name]))
                except Unscorable as why:
                    log.warning("no pair of %s and %s for %s %s: %s", METHOD, baseline, light.name, view.name, why)
            if not pairs:
                continue
            difference, error = np.transpose(pairs)
            rows.append(
                {
                    "object": opened.scene.name,
                    "light": light.name,
                    "baseline": baseline,
                    "difference": float(difference.mean()),
                    "standard_error": float(error.mean()),
                }
            )
    return rows


def means(objects: Sequence[Mapping[str, Mapping[str, float | None]]]) -> dict[str, dict[str, float | None]]:
    """By method and light, the plain mean over objects; None where one has no score."""
    out: dict[str, dict[str, float | None]] = {}
    for method, lights in objects[0].items() if objects else ():
        out[method] = {}
        for light in lights:
            values = [own[method].get(light) for own in objects]
            found = [v for v in values if v is not None]
            out[method][light] = float(np.mean(found)) if len(found) == len(values) else None
    return out


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
