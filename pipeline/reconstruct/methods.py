"""Running a method: samples -> model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.omissions import colour_groups
from pipeline.reconstruct.registry import known_methods, require_method
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
