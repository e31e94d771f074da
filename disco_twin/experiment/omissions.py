"""What the simulation of a scene does without, and why."""

from __future__ import annotations

import numpy as np

from disco_twin.experiment.experiment import Experiment
from disco_twin.object.bodies import OwnMedium


def left_out_by_the_twin(experiment: Experiment) -> list[dict[str, str]]:
    """Rows {what, because} of what the simulation leaves out; decided from the scene alone."""
    scene, medium = experiment.scene, experiment.object.medium
    out = []
    if medium.g_voxels is None and all(np.ptp(m) == 0 for a in (medium.sigma_t, medium.albedo) for m in a):
        out.append(("medium grid", "the medium is homogeneous"))
    if len(medium.sigma_t) > 1 and len(experiment.object.groups()) == 1:
        out.append(("a walk per wavelength", "sigma_t and g are the same at all wavelengths: one walk serves them"))
    if experiment.object.boundary.kind == "matched":
        out.append(("boundary sampling", "the object is index-matched"))
    own = [g for body in experiment.object.inside if isinstance(body.medium, OwnMedium) for g in body.medium.g]
    if medium.g_voxels is None and all(g == 0 for g in (*medium.g, *own)):
        out.append(("phase function sampling", "scattering is isotropic (g = 0)"))
    faults = [name for name, on in scene.rig.faults.model_dump().items() if not on]
    if faults:
        out.append((f"rig faults: {', '.join(faults)}", "the scene switches them off"))
    return [{"what": what, "because": because} for what, because in out]
