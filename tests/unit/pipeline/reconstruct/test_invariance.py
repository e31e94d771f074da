"""What must not matter to a reconstruction: units, how the object is turned, which view comes first. On the images of a
ball whose R_d differs from place to place, from the stream to the model.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reconstruct_capture
import trimesh
from numpy.typing import NDArray
from reconstruct_capture import ETA, SENSOR, reflectance, rig, write_capture
from scipy.spatial.distance import cdist

from hw.interface import Aim
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.geometry.camera import pose_rows
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.reconstruct.methods import reconstruct
from pipeline.reconstruct.samples.image_operators import footprint_reading
from pipeline.reconstruct.samples.samples import take_samples
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.reconstruct.surface_term.lobe_fit import subtract_reflection
from pipeline.stream.stream import StreamReader, StreamWriter

F64 = NDArray[np.float64]
FEW = 0.005  # of the stated deviations of its entries: as far as rounding may move a model


def side(points: F64) -> F64:
    return np.asarray(np.exp(0.4 * np.sin(points[:, 0] / 5.0 + 1.0) * np.cos(points[:, 2] / 6.0)))


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, trimesh.Trimesh]:
    folder = tmp_path_factory.mktemp("run") / "capture"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruct_capture, "pattern", side)
        return folder, write_capture(folder)


def reconstructed(folder: Path, calibration: Calibration, mesh: trimesh.Trimesh) -> RelightableModel:
    settings = ReconstructConfig(eta=ETA)
    with StreamReader(folder) as stream:
        cameras = [calibration.view_camera(v) for v in range(stream.plan.views)]
        readings = [footprint_reading(mesh, camera, ETA, settings.max_view_deg) for camera in cameras]
        taken, _ = take_samples(stream, calibration, mesh, {"it": readings}, settings)
    return reconstruct(subtract_reflection(taken["it"]), "default")


@pytest.fixture(scope="module")
def model(captured: tuple[Path, trimesh.Trimesh]) -> RelightableModel:
    folder, mesh = captured
    return reconstructed(folder, nominal_calibration(rig(), SENSOR), mesh)


def moved(calibration: Calibration, frame: F64, scale: float = 1.0) -> Calibration:
    """The calibration of the same devices in another object frame: x' = scale * frame @ x."""
    back = np.linalg.inv(frame)

    def pose(rows: object) -> object:
        out = np.array(rows, float) @ back
        out[:3, 3] *= scale
        return pose_rows(out)

    views = tuple(v.model_copy(update={"object_to_camera": pose(v.object_to_camera)}) for v in calibration.views)
    projectors = tuple(
        p.model_copy(
            update={
                "object_to_projector": pose(p.object_to_projector),
                "separation_mm": scale * p.separation_mm,
                "beam_diameter_mm": scale * p.beam_diameter_mm,
            }
        )
        for p in calibration.projectors
    )
    return calibration.model_copy(update={"views": views, "projectors": projectors})


def assert_same(a: RelightableModel, b: RelightableModel, scale: float = 1.0) -> None:
    """R_d, what is known of it, the boundary; a's lengths are `scale` times b's."""
    (own,), (other,) = a.terms, b.terms
    assert isinstance(own, GlobalTerm) and isinstance(other, GlobalTerm)
    assert own.variance is not None and other.variance is not None
    np.testing.assert_array_equal(own.measured, other.measured)
    off = (own.reflectance * scale**2 - other.reflectance) / np.sqrt(other.variance)
    assert np.sqrt((off**2).mean()) < FEW
    assert np.abs(np.log(own.variance * scale**4 / other.variance)).max() < 0.1
    np.testing.assert_allclose(a.boundary.ratio, b.boundary.ratio, rtol=2e-4)
    assert (own.tilt is None) == (other.tilt is None)


def test_the_object_differs_from_side_to_side(model: RelightableModel) -> None:
    """Of a ball that is the same all around nothing here would prove anything."""
    columns, points = model.terms[0].reflectance[0].sum(axis=1), np.asarray(model.mesh.vertices)
    truth = side(points) * (reflectance(cdist(points, points), 0) @ side(points))
    assert np.corrcoef(np.log(columns), np.log(truth))[0, 1] > 0.7  # 24 spots on 162 vertices
    assert columns.max() > 1.5 * columns.min()


def test_an_object_without_directions_is_left_alone(model: RelightableModel) -> None:
    """Rationale: images straight from eq. 2.1, which knows of no directions: no slopes, and the reason is stated."""
    assert model.terms[0].tilt is None
    assert "no change with direction" in model.provenance["without angular moments"]


def test_turning_the_object_changes_nothing(captured: tuple[Path, trimesh.Trimesh], model: RelightableModel) -> None:
    """Rationale: mesh, cameras and projectors turned together; the images are the same."""
    folder, mesh = captured
    frame = trimesh.transformations.rotation_matrix(1.1, [1, 2, -0.5])
    turned = mesh.copy()
    turned.apply_transform(frame)
    assert_same(reconstructed(folder, moved(nominal_calibration(rig(), SENSOR), frame), turned), model)


def test_units_change_nothing(captured: tuple[Path, trimesh.Trimesh], model: RelightableModel) -> None:
    """Rationale: all lengths ten times as large, and a camera a hundred times as sensitive shows the same images of an
    R_d that is a hundredth.
    """
    folder, mesh = captured
    grown = mesh.copy()
    grown.apply_scale(10.0)
    calibration = moved(nominal_calibration(rig(), SENSOR), np.eye(4), 10.0)
    sensitive = replace(SENSOR, responsivity=tuple(100 * r for r in SENSOR.responsivity))
    found = reconstructed(folder, calibration.model_copy(update={"sensor": sensitive}), grown)
    assert_same(found, model, 10.0)


def test_the_order_of_views_and_spots_changes_nothing(
    captured: tuple[Path, trimesh.Trimesh], model: RelightableModel, tmp_path: Path
) -> None:
    """Rationale: the same images with cameras, turntable angles and spots in reverse order."""
    folder, mesh = captured
    calibration = nominal_calibration(rig(), SENSOR)
    with StreamReader(folder) as stream:
        plan = stream.plan
        count = len(plan.angles_rad)
        spots = tuple(Aim(count - 1 - aim.angle, aim.u, aim.v) for aim in reversed(plan.spots))
        other = Plan(plan.cameras[::-1], plan.angles_rad[::-1], spots, plan.lasers)
        with StreamWriter(tmp_path, other) as writer:
            for address in other.addresses():
                spot = len(spots) - 1 - address.spot if address.spot >= 0 else -1
                old = ImageAddress(plan.views - 1 - address.view, address.kind, spot, address.laser)
                writer.append(address, stream.read(old), stream.meta(old))
    reverse = {"views": calibration.views[::-1], "projectors": calibration.projectors[::-1]}
    assert_same(reconstructed(tmp_path, calibration.model_copy(update=reverse), mesh), model)
