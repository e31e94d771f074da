"""What this capture does not need, decided from its data alone; every omission has its reason."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.calibrate.calibration import Calibration
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.samples.laser_samples import LaserSamples
from pipeline.reconstruct.samples.samples import Samples

LOCAL_SHARE = 0.99  # of the observed light within one edge: nothing is left for a global term
SAME_COLOUR = 2.0  # standard errors (and a thousandth) within which two lasers' samples count as equal


def share_within_an_edge(samples: Samples) -> float:
    """Share of the observed light that leaves within one edge and the beam's radius of its spot."""
    near = samples.spot_pairs.distance < samples.edge + samples.spots.beam_radius
    area = RayMesh.of(samples.mesh).vertex_areas
    power = np.stack([LaserSamples.of(samples, k).value * area for k in range(len(samples.values))])
    return float(power[:, near].sum() / max(power.sum(), 1e-30))


def is_opaque(samples: Samples) -> bool:
    """All light leaves where it enters, as far as the mesh resolves it."""
    return share_within_an_edge(samples) > LOCAL_SHARE


def colour_groups(samples: Samples) -> list[int]:
    """(L) for each laser the first laser whose samples equal its own within their noise."""
    groups: list[int] = []
    variance = samples.variance
    for laser in range(len(samples.values)):
        match = laser
        for earlier in sorted(set(groups)):
            if _equal(samples.values[[earlier, laser]], variance[[earlier, laser]]):
                match = earlier
                break
        groups.append(match)
    return groups


def _equal(values: NDArray[np.float32], variance: NDArray[np.float32]) -> bool:
    a, b = values.astype(np.float64)
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return False
    difference, total = (a - b)[both].sum(), (a + b)[both].sum() / 2
    noise = np.sqrt(variance.astype(np.float64)[:, both].sum())
    # The totals must agree, and so must the entries one by one: a pattern may differ at equal totals.
    spread = ((a - b)[both] ** 2).sum() / np.maximum(variance.astype(np.float64)[:, both].sum(), 1e-300)
    return bool(abs(difference) <= SAME_COLOUR * noise + 1e-3 * abs(total) and spread < SAME_COLOUR)


def omissions(samples: Samples, calibration: Calibration, scan: str | None = None) -> list[dict[str, str]]:
    """Rows {what, because} of what was left out for this capture; scan: why that was not fitted to silhouettes."""
    out = []
    if calibration.source == "nominal":
        nominal = "the calibration holds the nominal rig's geometry"
        out += [("pose and projector estimation", nominal), ("fitting the scan to silhouettes", nominal)]
    if scan is not None:
        out.append(("fitting the scan to silhouettes", scan))
    if not calibration.sensor.response:
        out.append(("response calibration", "the camera's digital numbers are linear by its data sheet"))
    if is_opaque(samples):
        share = share_within_an_edge(samples)
        out.append(("global term", f"{share:.1%} of the light leaves within one edge of its spot: opaque"))
    if samples.lobe is not None and samples.lobe.because:
        out.append(("the surface's reflection", samples.lobe.because))
    groups = colour_groups(samples)
    if len(groups) > 1 and len(set(groups)) < len(groups):
        kept = ", ".join(f"{calibration.lasers[k].wavelength_nm:g} nm" for k in sorted(set(groups)))
        out.append(("a model per wavelength", f"samples agree within their noise; solved for {kept} only"))
    return [{"what": what, "because": because} for what, because in out]
