"""The default method: the terms that are fitted to a capture, put together to one model."""

from __future__ import annotations

from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.baselines.lambertian import fit_lambertian
from pipeline.reconstruct.global_term.completion import complete
from pipeline.reconstruct.omissions import is_opaque
from pipeline.reconstruct.registry import method
from pipeline.reconstruct.samples.samples import Samples


@method("default", about="the completed matrix of R_d with the measured boundary", colour="#1f6391")
def reconstruct_default(samples: Samples) -> RelightableModel:
    """Samples -> model. An opaque object has no global term: all its light leaves within an edge of where it enters."""
    return fit_lambertian(samples) if is_opaque(samples) else complete(samples)
