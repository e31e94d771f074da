"""`disco-twin plan`: how many images, bytes and minutes a scene will take, before anything is simulated."""

from __future__ import annotations

import math

from disco_twin.noise import walks_below_camera
from disco_twin.world import World, left_out_by_the_twin
from pipeline.capture.targets import make_targets
from pipeline.resources import usable_cores

# Measured on an earlier quick.toml (alpha .3, mean free path about 1.7 mm, twice today's), per core and second; other
# media scale with the number of collisions, so this is a guess within a factor of two or three.
SPOT_WALKS, TRUTH_WALKS, REFERENCE_WALKS = 100_000.0, 50_000.0, 60_000.0
COMPRESSION = 7.0  # docs/decisions/0002
IMAGES_PER_S = 15.0  # of the real rig (thesis 4.1)
BYTES_PER_PIXEL = 3


def predict(world: World) -> list[tuple[str, str]]:
    """Lines (name, text) for the user."""
    scene, plan = world.scene, world.plan
    images = len(plan)
    pixels = scene.rig.cameras[0].width * scene.rig.cameras[0].height
    raw = images * pixels * BYTES_PER_PIXEL
    work = scene.simulation
    groups = len({(m.tobytes(), g) for m, g in zip(world.object.medium.sigma_t, world.object.medium.g, strict=True)})
    cores = usable_cores()
    seconds = {
        "capture": plan_walks(world) * groups / SPOT_WALKS / cores,
        "truth": work.truth_columns * work.truth_walks * groups / TRUTH_WALKS / cores,
        "references": len(scene.relight.lights) * work.reference_walks * groups / REFERENCE_WALKS / cores,
    }
    triangles, vertices = len(world.object.mesh.faces), len(world.scan.vertices)
    lines = [
        ("scene", f"{scene.name}: {triangles} triangles, scan of {vertices} vertices"),
        ("images", f"{images}: {plan.views} views, {len(plan.spots)} spots, {plan.lasers} lasers"),
        ("bytes", f"{raw / 1e6:.0f} MB raw, about {raw / COMPRESSION / 1e6:.1f} MB stored"),
        ("real rig", f"about {images / IMAGES_PER_S / 60:.1f} minutes of acquisition"),
    ]
    if scene.rig.faults.deviation:
        targets = sum(len(make_targets(scene.rig, c)[1]) for c in range(len(scene.rig.cameras)))
        lines.insert(2, ("calibration", f"{targets} images of chessboards and of a white plate"))
    lines += [(name, f"about {value / 60:.1f} minutes on {cores} cores") for name, value in seconds.items()]
    needed = walks_below_camera(scene)
    lines.append(
        (
            "noise",
            f"of the simulation up to {math.sqrt(needed / work.walks_per_spot):.0f} times the camera's in a pixel with "
            f"{work.walks_per_spot} walks a spot; {needed:.1e} bring it below the camera's in every pixel (within a "
            "factor of three); the spots' variance is kept pixel by pixel",
        )
    )
    lines += [("left out", f"{item['what']}: {item['because']}") for item in left_out_by_the_twin(world)]
    return lines


def plan_walks(world: World) -> float:
    """Photons of all spots together."""
    return float(len(world.plan.spots) * world.scene.simulation.walks_per_spot)
