"""The methods by name. A reconstruction is one function from samples to a model; a new one is a new entry here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.model.reflectance import ReflectanceModel
from pipeline.reconstruct.baselines.dipole import fit_dipole
from pipeline.reconstruct.baselines.disco2004 import resample_2004
from pipeline.reconstruct.baselines.lambertian import fit_lambertian
from pipeline.reconstruct.global_term.completion import complete
from pipeline.reconstruct.omissions import colour_groups, is_opaque
from pipeline.reconstruct.samples.image_operators import bilinear_reading, footprint_reading
from pipeline.reconstruct.samples.samples import Samples, select_lasers

READINGS = {"footprint": footprint_reading, "bilinear": bilinear_reading}


@dataclass(frozen=True)
class Reconstruction:
    """solve: samples -> model; reading: how the samples are read from the images."""

    solve: Callable[[Samples], ReflectanceModel]
    reading: Literal["footprint", "bilinear"] = "footprint"


METHODS: Mapping[str, Reconstruction] = {
    "default": Reconstruction(complete),
    "disco2004": Reconstruction(resample_2004, "bilinear"),
    "dipole": Reconstruction(fit_dipole),
    "lambertian": Reconstruction(fit_lambertian),
}


def reconstruct(samples: Samples, method: Reconstruction) -> ReflectanceModel:
    """Run a method on what the data need: equal wavelengths are solved once, an opaque object without global term."""
    groups = colour_groups(samples)
    kept = sorted(set(groups))
    solve = fit_lambertian if method.solve is complete and is_opaque(samples) else method.solve
    model = solve(select_lasers(samples, np.array(kept)))
    again = [kept.index(group) for group in groups]
    return replace(model, reflectance=model.reflectance[again], variance=model.variance[again])
