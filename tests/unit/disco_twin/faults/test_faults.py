"""All faults by one switch, and what the calibration's budget replaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.evaluate.true_calibration import VARIANTS, true_calibration
from disco_twin.experiment.experiment import Experiment
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.object.build import hat_basis
from disco_twin.scene.scene import load_scene
from hw.interface import Aim
from pipeline.calibrate.calibration import nominal_calibration
from pipeline.geometry.camera import pose_rows

QUICK = Path(__file__).parents[4] / "scenes" / "quick.toml"


def test_one_switch_turns_all_faults_on_or_off() -> None:
    """Without it they are as the scene says: the quick scene has them all."""
    for faults, every in ((None, True), (True, True), (False, False)):
        assert {*load_scene(QUICK, faults=faults).rig.faults.model_dump().values()} == {every}


def test_a_scanned_object_differs_from_the_object_by_the_scanners_errors() -> None:
    experiment = Experiment(load_scene(QUICK))
    exact, scan = experiment.object.mesh, experiment.scan
    assert scan.is_watertight
    assert abs(len(scan.vertices) / 1600 - 1) < 0.03
    assert abs((scan.volume / exact.volume) ** (1 / 3) - 1) * 18 < 0.15
    assert hat_basis(exact, scan).shape[1] == len(scan.vertices)


def test_the_true_calibration_is_the_actual_rig() -> None:
    """Cameras and beams of the truth that the budget uses are the twin's own, up to each mirror move's own error."""
    rig = load_scene(QUICK).rig
    actual = actual_rig(rig, 3)
    true = true_calibration(rig, actual, nominal_calibration(rig, lars3_sensor(rig)))
    for view in range(len(true.views)):
        camera = actual.camera(*divmod(view, true.n_angles))
        np.testing.assert_allclose(true.view_camera(view).pose, camera.pose)
        np.testing.assert_allclose(true.view_camera(view).focal, camera.focal)
    aims = [Aim(angle, 1000 + 90 * angle, 2000) for angle in range(3)]
    for mine, its in zip(true.spot_rays(aims), actual.spot_rays(aims), strict=True):
        np.testing.assert_allclose(mine, its, atol=1e-3)


def test_each_variant_replaces_its_own_part_only() -> None:
    rig = load_scene(QUICK).rig
    own = nominal_calibration(rig, lars3_sensor(rig))
    own = own.model_copy(
        update={"views": tuple(v.model_copy(update={"radiance_factor": (1.1, 1.0, 0.9)}) for v in own.views)}
    )
    true = true_calibration(rig, actual_rig(rig, 3), nominal_calibration(rig, lars3_sensor(rig)))
    light, pose, projector = (VARIANTS[f"true {x}"](own, true) for x in ("photometric", "pose", "projector"))
    assert light.views[0].radiance_factor == true.views[0].radiance_factor
    assert light.views[0].object_to_camera == own.views[0].object_to_camera
    assert light.projectors == own.projectors
    assert pose.views[0].radiance_factor == (1.1, 1.0, 0.9)
    assert pose.views[0].object_to_camera == true.views[0].object_to_camera
    assert projector.views == own.views
    assert projector.projectors[0].full_angle_rad == true.projectors[0].full_angle_rad


def test_a_variant_keeps_beams_and_images_together() -> None:
    """All poses measured in a frame that is turned by a degree: a part made true stays where the other part sees it."""
    rig = load_scene(QUICK).rig
    true = true_calibration(rig, actual_rig(rig, 3), nominal_calibration(rig, lars3_sensor(rig)))
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec(np.deg2rad([0.6, -0.8, 0.3])).as_matrix()
    views = [
        v.model_copy(update={"object_to_camera": pose_rows(np.array(v.object_to_camera) @ turned)}) for v in true.views
    ]
    projectors = [
        p.model_copy(update={"object_to_projector": pose_rows(np.array(p.object_to_projector) @ turned)})
        for p in true.projectors
    ]
    own = true.model_copy(update={"views": tuple(views), "projectors": tuple(projectors)})
    for name, same in (("true pose", true), ("true projector", own)):
        made = VARIANTS[name](own, true)
        for j in range(3):
            np.testing.assert_allclose(made.projector(j).pose, same.projector(j).pose, atol=1e-9)
            np.testing.assert_allclose(made.view_camera(j).pose, same.view_camera(j).pose, atol=1e-9)
