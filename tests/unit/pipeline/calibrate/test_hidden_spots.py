"""Which spots a camera sees, and which it only sees shine through the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from calibrate_twin import Glowing, experiment, faulty_rig
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from disco_twin.faults.actual_rig import actual_rig
from pipeline.calibrate import peaks

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Hidden:
    """Peaks of spots as both cameras see them; visible: whether each sees the spot itself, by ray casting."""

    peaks: list[peaks.Peak]
    power: F64
    beam_px: float
    visible: NDArray[np.bool_]

    def score(self) -> float:
        """Share of the images that are taken for what they are not."""
        bright = peaks.brightness(self.peaks, self.power)
        return float((peaks.seen(self.peaks, self.power, self.beam_px, bright) != self.visible).mean())


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    rig = faulty_rig(angles=(0.0,))
    actual, mesh = actual_rig(rig, 6), experiment().object.mesh
    source, caster = Glowing(rig, actual, mesh), RayMeshIntersector(mesh)
    found, visible, power = [], [], []
    rng = np.random.default_rng(4)
    aims = [a for a in experiment().plan.spots if a.angle == 0][::2]
    for camera in range(2):
        eye = actual.camera(camera, 0).position
        for aim in aims:
            origin, way = actual.spot_rays([aim])
            spot, _, face = caster.intersects_location(origin, way, multiple_hits=False)
            if not len(face):
                continue
            towards = eye - spot[0]
            towards /= np.linalg.norm(towards)
            normal = mesh.face_normals[face[0]]
            blocked = caster.intersects_any((spot[0] + 1e-3 * normal)[None], towards[None])[0]
            if abs(normal @ towards) < 0.15:
                continue  # at the rim either answer is right
            watts = float(rng.uniform(0.004, 0.012))
            image = source.image(camera, aim, 0) * watts
            found.append(peaks.find_peak(image + 2e-7 * rng.standard_normal(image.shape)))
            visible.append(bool(normal @ towards > 0 and not blocked))
            power.append(watts)
    beam = rig.projector.beam_diameter_mm * actual.cameras[0].focal[0] / 450.0
    return Hidden(found, np.array(power), float(beam), np.array(visible))


def test_hidden_spots_are_told_from_seen_ones(hidden: Hidden) -> None:
    """Expected: at most six images of a hundred mistaken, where both kinds are common."""
    assert 0.2 < hidden.visible.mean() < 0.8
    assert hidden.score() < 0.06
