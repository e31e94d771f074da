"""The simulation's noise of spot images beside the camera's, on three objects: plain walks, and a share of split ones.

Each object's spots at one turntable angle, seen by its rig's cameras, with the same time (as so many plain walks) both
ways, by turns; seconds are the processor's. Both are unbiased, so noise is all of their error.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

SCENES = Path(__file__).parents[1] / "scenes"
OBJECTS = ("quick", "accuracy/choose/animal", "accuracy/choose/figure")
SHARES = {"raw": 0.0, "split": 0.4}
SPOTS, WALKS = 8, 20_000


def run(quick: bool = False) -> dict[str, Any]:
    """`raw` and `split`: medians over objects of `median` and `p90` over the camera's deviation, `by_decade`,
    `unreached` and `cpu_s_per_spot`; `objects` holds the same by object and way.
    """
    rows: dict[str, dict[str, Any]] = {}
    for name in OBJECTS[: 1 if quick else None]:
        rows[name.rpartition("/")[2]] = of_object(SCENES / f"{name}.toml", SPOTS // (4 if quick else 1))
    result: dict[str, Any] = {"name": "noise", "quick": quick, "walks": WALKS, "objects": rows}
    return result | {way: middle([own[way] for own in rows.values()]) for way in SHARES}


def of_object(path: Path, count: int) -> dict[str, Any]:
    """Figures of each way on one object."""
    from disco_twin.evaluate.simulation_noise import noise_of
    from disco_twin.experiment.experiment import Experiment
    from disco_twin.faults.actual_rig import actual_rig
    from disco_twin.scene.scene import load_scene

    scene = load_scene(path)
    experiment = Experiment(scene)
    transport = experiment.transport
    from disco_twin.light.response import SpotResponses
    from disco_twin.light.spot_walks import SpotWalks

    first = list(experiment.plan.spots_at(0))
    aims = [experiment.plan.spots[first[k]] for k in np.linspace(0, len(first) - 1, count).astype(int)]
    found = {}
    for way, share in SHARES.items():
        for walks in (50, WALKS):  # the first compiles
            with tempfile.TemporaryDirectory() as folder:
                light = SpotResponses(
                    transport, scene.rig, actual_rig(scene.rig, scene.seed), SpotWalks.of(walks, share), 1, Path(folder)
                )
                light.prepare(aims)
                start = time.process_time()
                light.image(0, aims[0], 0)
                seconds = time.process_time() - start
                noise = noise_of(scene, [np.load(next(Path(folder).glob("*.npy")))])
        assert noise is not None
        found[way] = {
            "median": noise["median_over_camera"],
            "p90": noise["p90_over_camera"],
            "by_decade": {decade: own["over_camera"] for decade, own in noise["by_decade"].items()},
            "unreached": noise["unreached_object"],
            "cpu_s_per_spot": seconds / count,
        }
    return found


def middle(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The median of each figure over the objects; of a figure that one lacks, over the others."""

    def of(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return float(np.median(known)) if known else None

    decades = dict.fromkeys(decade for row in rows for decade in row["by_decade"])
    plain = {key: of([row[key] for row in rows]) for key in ("median", "p90", "unreached", "cpu_s_per_spot")}
    return plain | {"by_decade": {decade: of([row["by_decade"].get(decade) for row in rows]) for decade in decades}}
