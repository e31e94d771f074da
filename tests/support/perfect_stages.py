"""Outputs of every stage without an error, and the truth that they are judged by."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from calibrate_twin import experiment, faulty_rig
from numpy.typing import NDArray

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.evaluate.stage_figures import StageOutputs, TrueRun
from disco_twin.evaluate.true_calibration import true_calibration
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.light.balance import EnergyBalance
from disco_twin.light.truth import Truth
from pipeline.calibrate.calibration import nominal_calibration
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.samples.distances import beam_footprints
from pipeline.reconstruct.samples.spots import locate_spots
from pipeline.reconstruct.settings import ReconstructConfig

F64 = NDArray[np.float64]
COLUMNS = np.arange(5, 1500, 100)


@cache
def perfect() -> tuple[StageOutputs, TrueRun]:
    """The quick scene before a rig that is off, R_d that falls with distance, and outputs without any error."""
    rig, scan, plan = faulty_rig(), experiment().scan, experiment().plan
    calibration = true_calibration(rig, actual_rig(rig, 3), nominal_calibration(rig, lars3_sensor(rig)))
    spots = locate_spots(scan, calibration, plan, ReconstructConfig())
    distance = np.linalg.norm(scan.vertices[COLUMNS, None] - scan.vertices, axis=2)
    mean = np.stack([np.exp(-distance / length) / length**2 for length in (3.0, 4.0, 5.0)])
    zero: Any = np.zeros(3)
    balance = EnergyBalance(**dict.fromkeys(EnergyBalance.__dataclass_fields__, zero))
    replicates = mean * (1 + 1e-7 * np.resize([-1, 1], 8)[:, None, None, None])
    truth = Truth(COLUMNS, replicates, RayMesh.of(scan).vertex_areas, balance)
    values = np.full((3, len(plan.spots), len(scan.vertices)), np.nan)
    values[:, :, COLUMNS] = np.stack([beam_footprints(scan, spots) @ column.T for column in mean])
    lit = np.arange(len(COLUMNS)) % 2 == 0
    image = np.random.default_rng(1).uniform(1.0, 2.0, (3, 12, 16))
    hits = np.where(spots.transmitted[:, None] > 0, spots.position, np.nan)
    key, mask = ("uniform", "left"), np.ones((12, 16), bool)
    true = TrueRun(scan, plan, calibration, hits, truth, {key: np.stack([image, image])}, {"left": mask})
    return StageOutputs(calibration, spots, values, mean, lit, {key: image}), true
