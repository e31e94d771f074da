"""Figures of each stage: nothing for outputs that are the truth, and the size of an error that was put in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from perfect_stages import COLUMNS, perfect
from scipy.spatial.transform import Rotation

from disco_twin.evaluate.stage_figures import all_figures
from pipeline.calibrate.calibration import Calibration
from pipeline.geometry.camera import pose_rows

F64 = NDArray[np.float64]


def moved(calibration: Calibration, views: F64, projectors: F64) -> Calibration:
    """All views' and all projectors' poses after a (4, 4) motion of the object."""
    turned = [np.array(v.object_to_camera) @ views for v in calibration.views]
    aimed = [np.array(p.object_to_projector) @ projectors for p in calibration.projectors]
    pairs = zip(calibration.views, turned, strict=True)
    both = zip(calibration.projectors, aimed, strict=True)
    return calibration.model_copy(
        update={
            "views": tuple(v.model_copy(update={"object_to_camera": pose_rows(x)}) for v, x in pairs),
            "projectors": tuple(p.model_copy(update={"object_to_projector": pose_rows(x)}) for p, x in both),
        }
    )


def motion(rotation: tuple[float, float, float] = (0, 0, 0), shift: tuple[float, float, float] = (0, 0, 0)) -> F64:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def changed(**outputs: Any) -> dict[str, float]:
    """The figures that are no longer those of perfect outputs."""
    perfect_outputs, true = perfect()
    before = all_figures(perfect_outputs, true)
    after = all_figures(replace(perfect_outputs, **outputs), true)
    return {name: value for name, value in after.items() if abs(value - before[name]) > 1e-3}


def test_outputs_without_error_have_none() -> None:
    figures = all_figures(*perfect())
    assert {name.split("/")[0] for name in figures} == {"pose", "projector", "spots", "samples", "completion", "relit"}
    assert max(abs(value) for value in figures.values()) < 1e-6, figures


def test_a_lens_that_is_taken_for_another_is_an_error_of_the_pose() -> None:
    """A pixel of the image's centre is 44 um behind a lens of 62 mm: so many mm at the object's distance."""
    outputs, _ = perfect()
    own = outputs.calibration
    views = tuple(v.model_copy(update={"centre_px": (v.centre_px[0] + 1.0, v.centre_px[1])}) for v in own.views)
    distance = np.mean([np.linalg.norm(own.view_camera(v).position) for v in range(len(views))])
    found = changed(calibration=own.model_copy(update={"views": views}))
    assert found == {"pose/image mm": pytest.approx(0.044 / 62.0 * distance, rel=0.02)}


def test_a_frame_that_is_turned_for_cameras_and_projector_alike_is_an_error_of_the_frame_alone() -> None:
    outputs, true = perfect()
    turned = motion(rotation=(0.01, 0.0, 0.0))
    found = changed(calibration=moved(outputs.calibration, turned, turned))
    from_axis = np.sqrt((true.scan.vertices[:, 1:] ** 2).sum(axis=1).mean())
    assert found == {"pose/frame mm": pytest.approx(0.01 * from_axis, rel=1e-3)}


def test_a_projector_that_stands_elsewhere_misses_by_as_much() -> None:
    outputs, _ = perfect()
    found = changed(calibration=moved(outputs.calibration, motion(), motion(shift=(0.0, 0.0, 0.5))))
    assert found == {"projector/aim mm": pytest.approx(0.5, rel=0.05)}  # across the beams, which come from the side


def test_errors_of_spots_samples_entries_and_images_have_their_size() -> None:
    outputs, _ = perfect()
    found = changed(spots=replace(outputs.spots, position=outputs.spots.position + np.array([0.0, 0.3, 0.0])))
    assert found.pop("spots/place mm") == pytest.approx(0.3)
    assert all(name.startswith("samples/") for name in found)  # they are then said of other places
    for stage, change in (
        ("samples", {"values": 10**0.1 * outputs.values}),
        ("completion", {"exitance": 10**0.1 * outputs.exitance}),
    ):
        found = changed(**change)
        assert found == dict.fromkeys(found, pytest.approx(0.1, abs=1e-4))
        assert len(found) == (6 if stage == "samples" else 8)
        assert all(name.startswith(stage) for name in found)
    found = changed(images={key: 1.1 * image for key, image in outputs.images.items()})
    assert found == dict.fromkeys(("relit/uniform@left nrmse", "relit/uniform@left energy - 1"), pytest.approx(0.1))


def test_totals_that_scatter_and_are_too_low_show_both() -> None:
    """Lit columns by turns a tenth too high and a tenth too low, whose bias is its standard error then; unlit ones a
    tenth too low.
    """
    outputs, _ = perfect()
    factor = np.where(outputs.lit, np.where(np.arange(len(COLUMNS)) % 4 == 0, 1.1, 0.9), 0.9)
    found = changed(exitance=outputs.exitance * factor[:, None])
    assert found["completion/lit totals spread"] == pytest.approx(0.1, rel=0.1)
    error = 0.1 / np.sqrt(outputs.lit.sum()) / np.log(10)
    assert abs(found["completion/lit totals log10 bias"]) == pytest.approx(error, rel=0.3)
    assert found["completion/unlit totals log10 bias"] == pytest.approx(np.log10(0.9), abs=1e-6)
    assert "completion/unlit totals spread" not in found


def test_what_was_not_observed_or_is_not_positive_is_no_perfect_sample() -> None:
    outputs, _ = perfect()
    found = changed(values=np.where(np.isfinite(outputs.values), -1.0, np.nan))
    assert found["samples/decade 0 log10 rmse"] == pytest.approx(1.0)  # a decade off
    found = changed(values=np.full_like(outputs.values, np.nan))
    assert found["samples/decade 0 log10 rmse"] == np.inf
