"""A half-space with a known answer: isotropic scattering under Chandrasekhar's H functions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from twins import block, twin

from disco_twin.object.build import TwinObject

F64 = NDArray[np.float64]

# Diffuse reflectance of a half-space without its specular part: isotropic scattering, normal incidence, albedo
# .9, .99, .999 and .9999 (Chandrasekhar's H function with Fresnel's boundary; at n = 1 it is 1 - sqrt(1 - c) H(1)).
HALF_SPACE = {
    1.0: (0.414947, 0.752721, 0.912845, 0.971418),
    1.3: (0.285783, 0.645394, 0.856754, 0.940717),
    1.5: (0.219919, 0.561981, 0.801459, 0.905536),
}


def half_space(n: float, albedo: tuple[float, ...], width: float = 80.0, depth: float = 20.0) -> TwinObject:
    """A block of 10 mean free paths a millimetre, so wide and deep that nothing reaches its other sides."""
    return twin(block(width, depth), "matched" if n == 1 else "smooth", n, 10.0, albedo)


@dataclass(frozen=True)
class HFunction:
    """Chandrasekhar's H for isotropic scattering of this albedo (Radiative Transfer, 1960, section 39).

    albedo: c; nodes, weights: (n,) Gauss's rule on (0, 1); values: (n,) H at the nodes
    """

    albedo: float
    nodes: F64
    weights: F64
    values: F64

    @classmethod
    def of(cls, albedo: float, nodes: int = 200) -> HFunction:
        """By iteration of 1/H = sqrt(1 - c) + c/2 int m H(m) / (mu + m) dm."""
        x, w = np.polynomial.legendre.leggauss(nodes)
        found = cls(albedo, (x + 1) / 2, w / 2, np.ones(nodes))
        for _ in range(6000):
            new = found(found.nodes)
            if np.abs(new - found.values).max() < 1e-14:
                break
            # Without absorption every other step overshoots: the mean of two does not.
            found = cls(albedo, found.nodes, found.weights, (found.values + new) / 2)
        return found

    @property
    def root(self) -> float:
        """sqrt(1 - c)."""
        return math.sqrt(1 - self.albedo)

    def __call__(self, mu: ArrayLike) -> F64:
        """H at cosines."""
        at = np.asarray(mu, float)[..., None]
        integral = (self.nodes * self.values * self.weights / (at + self.nodes)).sum(axis=-1)
        return np.asarray(1 / (self.root + self.albedo / 2 * integral))

    def derivative(self, mu: ArrayLike) -> F64:
        """dH / dmu, from the same equation."""
        at = np.asarray(mu, float)[..., None]
        integral = (self.nodes * self.values * self.weights / (at + self.nodes) ** 2).sum(axis=-1)
        return np.asarray(self(mu) ** 2 * self.albedo / 2 * integral)

    def moment(self, order: int) -> float:
        """alpha_n = int mu^n H dmu."""
        return float((self.nodes**order * self.values * self.weights).sum())

    def given_back(self, mu: ArrayLike) -> F64:
        """Share of a beam of this cosine that leaves again: 1 - sqrt(1 - c) H(mu)."""
        return np.asarray(1 - self.root * self(mu))

    def seen(self, entry: ArrayLike, leaving: ArrayLike) -> F64:
        """Radiance, summed over the surface, toward a cosine per watt of a beam of another (eq. III.120 over mu_0)."""
        mu0, mu = np.asarray(entry, float), np.asarray(leaving, float)
        return np.asarray(self.albedo / (4 * np.pi) * self(mu0) * self(mu) / (mu0 + mu))

    def displacement(self, entry: ArrayLike) -> F64:
        """Mean place at which a beam's light leaves, along its way, in free paths from where it enters.

        Light that has scattered once forgets its direction, and all later flights cancel in the mean; the first one
        is tau / mu_0 long, so the mean of tau tan(theta) over what leaves is wanted. That is the logarithmic derivative
        of what leaves by 1 / mu_0: with a = `given_back`, sin(theta) (1 - mu_0 sqrt(1 - c) H' / a).
        """
        mu = np.asarray(entry, float)
        return np.asarray(np.sqrt(1 - mu**2) * (1 + mu * -self.root * self.derivative(mu) / self.given_back(mu)))

    def displacement_to(self, entry: ArrayLike, leaving: ArrayLike) -> F64:
        """The same of the light that leaves in one direction, but for what its own last flight adds along that."""
        mu0, mu = np.asarray(entry, float), np.asarray(leaving, float)
        return np.asarray(np.sqrt(1 - mu0**2) * (mu / (mu0 + mu) + mu0 * self.derivative(mu0) / self(mu0)))
