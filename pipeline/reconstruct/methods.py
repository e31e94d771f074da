"""Running a method, samples -> model; and the default one, which puts the terms that are fitted to a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.baselines.lambertian import fit_lambertian
from pipeline.reconstruct.global_term.completion import complete
from pipeline.reconstruct.omissions import colour_groups, is_opaque
from pipeline.reconstruct.registry import known_methods, method, require_method
from pipeline.reconstruct.samples.samples import Samples, select_lasers


def reconstruct(samples: Samples, name: str) -> RelightableModel:
    """Run a method on what the data need: wavelengths whose samples agree are solved once.

    Raises: InputError for an unknown method.
    """
    groups = colour_groups(samples)
    kept = sorted(set(groups))
    solved: RelightableModel = known_methods()[require_method(name)].load()(select_lasers(samples, np.array(kept)))
    model = solved.of_lasers([kept.index(group) for group in groups])
    return replace(model, provenance={"method": name} | dict(model.provenance))


@method("default", about="the completed matrix of R_d with the measured boundary", colour="#0a4c86")
def reconstruct_default(samples: Samples) -> RelightableModel:
    """Samples -> model. An opaque object has no global term: all its light leaves within an edge of where it enters."""
    return fit_lambertian(samples) if is_opaque(samples) else complete(samples)
