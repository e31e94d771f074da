"""`disco-twin plan`: how many images, bytes and minutes a scene will take, before anything is simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from disco_twin.evaluate.simulation_noise import (
    SpotCost,
    coarse_estimate,
    lit_vertices,
    spot_cost,
    walks_below_camera,
)
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.ground_truth import MOMENT_WALKS
from disco_twin.experiment.omissions import left_out_by_the_twin
from disco_twin.experiment.references import holds_reference
from disco_twin.light.importance import window_targets
from disco_twin.light.spot_walks import EFFORT
from hw.base.resources import usable_cores
from pipeline.plan.targets import make_targets

# Core-seconds of stages as runs of quick.toml time them, compilation included (docs/decisions/0052), beside those of so
# many plain walks. Other media scale with the number of collisions: there a guess within a factor of two or three.
TRUTH_COST = 0.9  # of a column's walk, with windows and without cameras
EXPOSURE_S = 0.004  # of a spot's image: window, exposure, codec
REFERENCE_WALKS = 8e6  # of a light, in both of quick's views at 3 % noise (docs/decisions/0054)
COMPRESSION = 7.0  # docs/decisions/0002
IMAGES_PER_S = 15.0  # of the real rig (thesis 4.1)
BYTES_PER_PIXEL = 3


def simulation_seconds(experiment: Experiment, spot: SpotCost, lights: int, cores: int) -> dict[str, float]:
    """Seconds of each stage that walks photons, by the wall clock. lights: how many have references to be rendered.

    Wavelengths that share sigma_t and g share their walks.
    """
    work, plan = experiment.scene.simulation, experiment.plan
    images = sum(view.width * view.height for view in experiment.scene.relight.views) / (2 * 192 * 124)  # of quick's
    walk = spot.seconds / spot.time_walks
    exposures = len(plan) * EXPOSURE_S
    return {
        "capture": (len(plan.spots) * spot.seconds + exposures) / cores,
        "truth": work.truth_columns
        * work.truth_walks
        * (1 + MOMENT_WALKS)
        * TRUTH_COST
        * walk
        * copies_at_start(experiment)
        / cores,
        "references": lights * REFERENCE_WALKS * walk * images * (0.03 / work.reference_noise) ** 2 / cores,
    }


def copies_at_start(experiment: Experiment) -> float:
    """Into how many copies a photon of the truth's columns is split where it starts, in the mean."""
    estimate, scan = coarse_estimate(experiment), experiment.scan
    chosen = lit_vertices(experiment)
    found = []
    for vertex in chosen:
        corners = scan.vertices[scan.faces[(scan.faces == vertex).any(axis=1)]]
        places = corners.mean(axis=1) / 4 * 3 + scan.vertices[vertex] / 4  # of triangles' shares of the hat
        target = window_targets(estimate.fluence(places[None]), estimate.filled, EFFORT)[0, estimate.filled]
        found.append((1 / target[estimate.unknowns(places)]).mean())
    return float(np.mean(found))


def duration(seconds: float) -> str:
    """About how long, in minutes, hours or days."""
    for unit, length in (("minutes", 60.0), ("hours", 3600.0)):
        if seconds < 100 * length:
            return f"about {seconds / length:.1f} {unit}" if seconds >= 0.1 * length else f"less than .1 {unit}"
    return f"about {seconds / 86400:.3g} days"


def predict(experiment: Experiment, shipped: Path) -> list[tuple[str, str]]:
    """Lines (name, text) for the user. shipped: folder of references that are taken instead of rendered."""
    scene, plan = experiment.scene, experiment.plan
    images = len(plan)
    pixels = scene.rig.cameras[0].width * scene.rig.cameras[0].height
    raw = images * pixels * BYTES_PER_PIXEL
    responses = len(plan.spots) * plan.lasers * len(scene.rig.cameras) * pixels
    scratch = responses * 2 * np.dtype(np.float32).itemsize  # image and variance
    cores, views = usable_cores(), scene.relight.views
    lights = sum(not all(holds_reference(shipped, experiment, x, v) for v in views) for x in scene.relight.lights)
    spot = spot_cost(experiment)
    seconds = simulation_seconds(experiment, spot, lights, cores)
    triangles, vertices = len(experiment.object.mesh.faces), len(experiment.scan.vertices)
    inside = len(experiment.object.inside)
    walls = f", {inside} surface{'s' if inside > 1 else ''} inside it" if inside else ""
    lines = [
        ("scene", f"{scene.name}: {triangles} triangles{walls}, scan of {vertices} vertices"),
        ("images", f"{images}: {plan.views} views, {len(plan.spots)} spots, {plan.lasers} lasers"),
        (
            "bytes",
            f"{raw / 1e6:.0f} MB raw, about {raw / COMPRESSION / 1e6:.1f} MB stored; {scratch / 1e6:.0f} MB more of "
            "simulated responses in OUT/twin (none with real cameras)",
        ),
        ("real rig", f"about {images / IMAGES_PER_S / 60:.1f} minutes of acquisition"),
    ]
    if scene.rig.faults.deviation:
        targets = sum(len(make_targets(scene.rig, c)[1]) for c in range(len(scene.rig.cameras)))
        lines.insert(2, ("calibration", f"{targets} images of chessboards and of a white plate"))
    lines += [(name, f"{duration(value)} on {cores} cores") for name, value in seconds.items() if value]
    if not lights:
        lines.append(("references", "none to render: they lie beside the scene"))
    needed = walks_below_camera(scene)
    lines.append(
        (
            "noise",
            f"of the simulation {spot.median:.3g} times the camera's in the median pixel, in the time of "
            f"{spot.time_walks} plain walks a spot ({spot.seconds:.2g} s of a core); half of it takes four times as "
            f"long, {needed:.1e} plain walks bring it below the camera's in every pixel",
        )
    )
    by_decade = ", ".join(f"{decade}: {ratio:.3g}" for decade, ratio in spot.by_decade.items())
    sure = "to decade -3 within a factor of three, the median within five; fainter ones are taken for too noisy"
    lines.append(("", f"by decade below a spot's peak {by_decade} ({sure})"))
    lines += [("left out", f"{item['what']}: {item['because']}") for item in left_out_by_the_twin(experiment)]
    return lines
