"""`disco-twin plan`: how many images, bytes and minutes a scene will take, before anything is simulated."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from disco_twin.evaluate.simulation_noise import walks_below_camera
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.omissions import left_out_by_the_twin
from disco_twin.experiment.references import holds_reference
from hw.base.resources import usable_cores
from pipeline.plan.targets import make_targets

# Walks per core and second of quick.toml's stages as a run times them, compilation and the images' exposure included
# (docs/decisions/0052). Other media scale with the number of collisions: there a guess within a factor of two or three.
SPOT_WALKS, TRUTH_WALKS = 85_000.0, 110_000.0
REFERENCE_SECONDS = 80.0  # core-seconds of a light, in both of quick's views at 3 % noise (docs/decisions/0054)
COMPRESSION = 7.0  # docs/decisions/0002
IMAGES_PER_S = 15.0  # of the real rig (thesis 4.1)
BYTES_PER_PIXEL = 3


def simulation_seconds(experiment: Experiment, lights: int, cores: int) -> dict[str, float]:
    """Seconds of each stage that walks photons, by the wall clock. lights: how many have references to be rendered.

    Wavelengths that share sigma_t and g share their walks.
    """
    work, medium = experiment.scene.simulation, experiment.object.medium
    images = sum(view.width * view.height for view in experiment.scene.relight.views) / (2 * 192 * 124)  # of quick's
    groups = len({(m.tobytes(), g) for m, g in zip(medium.sigma_t, medium.g, strict=True)})
    return {
        "capture": len(experiment.plan.spots) * work.walks_per_spot * groups / SPOT_WALKS / cores,
        "truth": work.truth_columns * work.truth_walks * groups / TRUTH_WALKS / cores,
        "references": lights * REFERENCE_SECONDS * groups * images * (0.03 / work.reference_noise) ** 2 / cores,
    }


def predict(experiment: Experiment, shipped: Path) -> list[tuple[str, str]]:
    """Lines (name, text) for the user. shipped: folder of references that are taken instead of rendered."""
    scene, plan = experiment.scene, experiment.plan
    images = len(plan)
    pixels = scene.rig.cameras[0].width * scene.rig.cameras[0].height
    raw = images * pixels * BYTES_PER_PIXEL
    responses = len(plan.spots) * plan.lasers * len(scene.rig.cameras) * pixels
    scratch = responses * 2 * np.dtype(np.float32).itemsize  # image and variance
    work = scene.simulation
    cores, views = usable_cores(), scene.relight.views
    lights = sum(not all(holds_reference(shipped, experiment, x, v) for v in views) for x in scene.relight.lights)
    seconds = simulation_seconds(experiment, lights, cores)
    triangles, vertices = len(experiment.object.mesh.faces), len(experiment.scan.vertices)
    lines = [
        ("scene", f"{scene.name}: {triangles} triangles, scan of {vertices} vertices"),
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
    lines += [(name, f"about {value / 60:.1f} minutes on {cores} cores") for name, value in seconds.items() if value]
    if not lights:
        lines.append(("references", "none to render: they lie beside the scene"))
    needed = walks_below_camera(scene)
    lines.append(
        (
            "noise",
            f"of the simulation up to {math.sqrt(needed / work.walks_per_spot):.0f} times the camera's in a pixel with "
            f"{work.walks_per_spot} walks a spot; {needed:.1e} bring it below the camera's in every pixel (within a "
            "factor of three); the spots' variance is kept pixel by pixel",
        )
    )
    lines += [("left out", f"{item['what']}: {item['because']}") for item in left_out_by_the_twin(experiment)]
    return lines
