"""Outputs of a stage made worse on purpose, until one of its figures has grown by a tenth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from disco_twin.evaluate.stage_figures import FIGURES, StageOutputs, TrueRun
from disco_twin.faults.actual_rig import nudge
from pipeline.calibrate.calibration import Calibration
from pipeline.geometry.camera import pose_rows

WORSE = 1.10
LARGEST = (0.01, 0.1, 1.0, 10.0)  # sizes of perturbations that are tried

Perturbation = Callable[[StageOutputs, float, Generator], StageOutputs]


def _shaken_views(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    own = outputs.calibration
    moved = [_posed(v, nudge(rng, size, 2 * size) @ np.array(v.object_to_camera)) for v in own.views]
    return replace(outputs, calibration=own.model_copy(update={"views": tuple(moved)}))


def _turned_frames(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    own = outputs.calibration
    turns = [nudge(rng, 0.0, size) for _ in range(own.n_angles)]
    moved = [_posed(v, np.array(v.object_to_camera) @ turns[i % own.n_angles]) for i, v in enumerate(own.views)]
    return replace(outputs, calibration=own.model_copy(update={"views": tuple(moved)}))


def _posed(view: Any, pose: Any) -> Any:
    return view.model_copy(update={"object_to_camera": pose_rows(pose)})


def _shifted_projector(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    own, motion = outputs.calibration, nudge(rng, size, size / 10)
    moved = [
        p.model_copy(update={"object_to_projector": pose_rows(motion @ np.array(p.object_to_projector))})
        for p in own.projectors
    ]
    calibration: Calibration = own.model_copy(update={"projectors": tuple(moved)})
    return replace(outputs, calibration=calibration)


def _scattered_spots(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    position = outputs.spots.position
    return replace(
        outputs, spots=replace(outputs.spots, position=position + size * rng.standard_normal(position.shape))
    )


def _moved_spots(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    return replace(
        outputs, spots=replace(outputs.spots, position=outputs.spots.position + size * rng.standard_normal(3))
    )


def _noisy_samples(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    return replace(outputs, values=outputs.values * np.exp(size * rng.standard_normal(outputs.values.shape)))


def _scaled_samples(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    return replace(outputs, values=outputs.values * np.exp(_sign(rng) * size))


def _noisy_entries(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    entries = outputs.exitance
    assert entries is not None
    return replace(outputs, exitance=entries * np.exp(size * rng.standard_normal(entries.shape)))


def _scaled_entries(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    entries = outputs.exitance
    assert entries is not None
    return replace(outputs, exitance=entries * np.exp(_sign(rng) * size))


def _noisy_images(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    return _with_images(outputs, lambda image: image * np.exp(size * rng.standard_normal(image.shape)))


def _scaled_images(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    factor = np.exp(_sign(rng) * size)
    return _with_images(outputs, lambda image: image * factor)


def _blurred_images(outputs: StageOutputs, size: float, rng: Generator) -> StageOutputs:
    return _with_images(outputs, lambda image: gaussian_filter(image, (0, 10 * size, 10 * size)))


def _with_images(outputs: StageOutputs, change: Callable[[Any], Any]) -> StageOutputs:
    return replace(outputs, images={key: change(image) for key, image in outputs.images.items()})


def _sign(rng: Generator) -> int:
    return int(rng.choice([-1, 1]))


PERTURBATIONS: dict[str, tuple[Perturbation, ...]] = {
    "pose": (_shaken_views, _turned_frames),
    "projector": (_shifted_projector,),
    "spots": (_scattered_spots, _moved_spots),
    "samples": (_noisy_samples, _scaled_samples),
    "completion": (_noisy_entries, _scaled_entries),
    "relit": (_noisy_images, _scaled_images, _blurred_images),
}


def stage_outputs(outputs: StageOutputs) -> Iterator[tuple[str, StageOutputs]]:
    """(stage, outputs) for each stage; relit images one by one, so that each is perturbed alone."""
    for stage in FIGURES:
        if stage != "relit":
            yield stage, outputs
    for key, image in outputs.images.items():
        yield "relit", replace(outputs, images={key: image})


def made_worse(
    stage: str, outputs: StageOutputs, true: TrueRun, perturbation: Perturbation, name: str, seed: int
) -> StageOutputs | None:
    """The outputs perturbed until the error `name` is `WORSE` times what it was; None where it never is."""
    before = abs(FIGURES[stage](outputs, true)[name])

    def perturbed(size: float) -> StageOutputs:
        return perturbation(outputs, size, np.random.default_rng(seed))

    def growth(size: float) -> float:
        return abs(FIGURES[stage](perturbed(size), true)[name]) / before - WORSE

    largest = next((size for size in LARGEST if growth(size) > 0), None)
    return None if largest is None else perturbed(brentq(growth, 0.0, largest, xtol=1e-6, rtol=1e-4))
