"""What a rough surface reflects of a spot's beam, in the units of the samples.

It shows where the beam meets the surface and nowhere else: a sample is the mean over a hat function of

    pi f_r(w_i, w_o) b(x) / (F_t(w_i) F_t(w_o)),

with f_r the BRDF and b the beam's irradiance per power (docs/decisions/0123).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from hw.base.arrays import F64, I64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import transmittance
from pipeline.geometry.microfacet import reflected
from pipeline.reconstruct.samples.spots import Spots

LEAST_COSINE = 0.02  # of a view to the surface, below which neither F_t nor the lobe is known


@dataclass(frozen=True)
class BeamReadings:
    """Readings of vertices that a beam meets: (K,) spot, vertex and view, and the weight of the view in the sample,
    mean over the lasers.
    """

    spot: I64
    vertex: I64
    view: I64
    weight: F64

    @classmethod
    def none(cls) -> BeamReadings:
        """No vertex was read where a beam met it."""
        nothing = np.zeros(0, np.int64)
        return cls(nothing, nothing, nothing, np.zeros(0))


def seen_by(camera: PinholeCamera, spots: Spots, eta: float, alpha: float) -> F64:
    """(S,) pi f_r / (F_t(w_i) F_t(w_o)) of a lobe of strength 1 at each spot; 0 where a camera does not look at it."""
    towards = camera.position - spots.position
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    half = towards - spots.direction
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-12)
    entering, leaving = -(spots.normal * spots.direction).sum(axis=1), (spots.normal * towards).sum(axis=1)
    used = np.flatnonzero((spots.transmitted > 0) & (leaving > LEAST_COSINE))
    out = np.zeros(len(towards))
    cosines = (half * spots.normal).sum(axis=1)[used], (half * towards).sum(axis=1)[used]
    brdf = reflected(*cosines, entering[used], leaving[used], eta, alpha)
    out[used] = np.pi * brdf / (spots.transmitted[used] * transmittance(leaving[used], eta))
    return out


@dataclass(frozen=True)
class BeamOnHats:
    """density: (S, V) mm^-2, mean over each hat function of the beam's irradiance per power; cameras: of the views."""

    spots: Spots
    eta: float
    density: sparse.csr_array
    cameras: tuple[PinholeCamera, ...]
    readings: BeamReadings = field(default_factory=BeamReadings.none)

    def in_view(self, camera: PinholeCamera, alpha: float) -> sparse.csr_array:
        """(S, V) mm^-2, what a lobe of strength 1 adds to what one camera sees."""
        at_spots = seen_by(camera, self.spots, self.eta, alpha)
        return sparse.csr_array(sparse.diags_array(at_spots) @ self.density)

    def in_samples(self, alpha: float) -> F64:
        """(K,) mm^-2, what a lobe of strength 1 adds to the samples of the pairs in `readings`, view by view."""
        at_spots = np.array([seen_by(camera, self.spots, self.eta, alpha) for camera in self.cameras])
        r = self.readings
        return np.asarray(r.weight * at_spots[r.view, r.spot] * self.density[r.spot, r.vertex])


@dataclass(frozen=True)
class SurfaceLobe:
    """A reflection as a sum of GGX lobes.

    alphas: (A,) their roughness; strengths: (A,) in units of the reflection of the assumed index; error: standard error
    of the strengths' sum; because: why nothing is taken off the samples
    """

    alphas: tuple[float, ...] = ()
    strengths: tuple[float, ...] = ()
    error: float = 0.0
    because: str = ""

    @property
    def strength(self) -> float:
        """Of all lobes together."""
        return float(sum(self.strengths))

    @property
    def alpha(self) -> float:
        """Mean roughness, by strength."""
        return float(np.dot(self.alphas, self.strengths)) / max(self.strength, 1e-30)

    def described(self, eta: float) -> str:
        """In words; eta: the assumed index."""
        return f"GGX alpha {self.alpha:.2f}, {self.strength:.2f}({self.error:.2f}) times that of index {eta:g}"

    def in_samples(self, beams: BeamOnHats) -> F64:
        """(K,) mm^-2, what is added to the samples of the pairs in `beams.readings`."""
        parts = [s * beams.in_samples(a) for a, s in zip(self.alphas, self.strengths, strict=True)]
        return np.asarray(sum(parts, np.zeros(len(beams.readings.spot))))

    def in_view(self, beams: BeamOnHats, camera: PinholeCamera) -> F64:
        """(S, V) mm^-2, what is added to what one camera sees."""
        parts = [s * beams.in_view(camera, a) for a, s in zip(self.alphas, self.strengths, strict=True)]
        return np.asarray(sum(parts, sparse.csr_array(beams.density.shape)).toarray())
