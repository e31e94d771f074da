"""Reflection and transmission of layers with Henyey-Greenstein phase functions, by discrete ordinates and adding.

Plane layers, no boundary, light that does not depend on the azimuth. Each thin layer is solved by the exponential of
its matrix, layers are added after van de Hulst (Multiple Light Scattering, 1980, chapter 4): no step, and no line of
code, is shared with the walk.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm
from scipy.special import eval_legendre, roots_jacobi

F64 = NDArray[np.float64]

ORDERS = 48  # of the phase function's Legendre series: g^48 is what is left out
NODES = 32


@dataclass(frozen=True)
class Part:
    """One scatterer of a layer: sigma_s in 1/mm and its g."""

    sigma_s: float
    g: float


@dataclass(frozen=True)
class Layer:
    """A layer `depth` mm thick with the extinction sigma_t 1/mm; its scatterers act side by side."""

    depth: float
    sigma_t: float
    parts: Sequence[Part]


def radau() -> tuple[F64, F64]:
    """Gauss-Radau nodes and weights on (0, 1] with a node at 1, where the normal beam is."""
    x, w = roots_jacobi(NODES - 1, 1, 0)
    return np.append((x + 1) / 2, 1.0), np.append(w / (1 - x) / 2, 1 / NODES**2)


def redistribution(parts: Sequence[Part], mu: ArrayLike, other: ArrayLike) -> F64:
    """(n, m) sigma_s times the azimuthal mean of the phase function from cosines `other` to `mu`."""
    orders = np.arange(ORDERS)[:, None]
    one, two = eval_legendre(orders, np.asarray(mu)), eval_legendre(orders, np.asarray(other))
    weight = sum(part.sigma_s * part.g ** orders[:, 0] for part in parts) * (2 * orders[:, 0] + 1)
    return np.asarray(np.einsum("k,ki,kj->ij", weight, one, two))


def thin(layer: Layer, nodes: F64, weights: F64) -> tuple[F64, F64]:
    """(n, n) reflection and transmission of radiance by a thin homogeneous layer, the same from both sides."""
    forth = redistribution(layer.parts, nodes, nodes) * weights / 2
    back = redistribution(layer.parts, nodes, -nodes) * weights / 2
    rate = (forth - layer.sigma_t * np.eye(len(nodes))) / nodes[:, None]
    turn = back / nodes[:, None]
    passed = expm(np.block([[rate, turn], [-turn, -rate]]) * layer.depth)
    n = len(nodes)
    a, b, c, d = passed[:n, :n], passed[:n, n:], passed[n:, :n], passed[n:, n:]
    reflected = -np.linalg.solve(d, c)
    return reflected, a + b @ reflected


@dataclass(frozen=True)
class Stack:
    """(n, n) reflection and transmission of light from above and of light from below."""

    reflected: F64
    passed: F64
    reflected_below: F64
    passed_below: F64

    def on(self, other: Stack) -> Stack:
        """This one upon another."""
        one = np.eye(len(self.passed))
        down = np.linalg.inv(one - self.reflected_below @ other.reflected)  # after all turns between the two
        up = np.linalg.inv(one - other.reflected @ self.reflected_below)
        return Stack(
            self.reflected + self.passed_below @ other.reflected @ down @ self.passed,
            other.passed @ down @ self.passed,
            other.reflected_below + other.passed @ self.reflected_below @ up @ other.passed_below,
            self.passed_below @ up @ other.passed_below,
        )


def doubled(layer: Layer, nodes: F64, weights: F64) -> Stack:
    """A layer of any thickness: a thin one, doubled."""
    times = max(0, int(np.ceil(np.log2(layer.sigma_t * layer.depth / nodes.min()))))
    reflected, passed = thin(replace(layer, depth=layer.depth / 2**times), nodes, weights)
    stack = Stack(reflected, passed, reflected, passed)
    for _ in range(times):
        stack = stack.on(stack)
    return stack


def reflected_and_transmitted(layers: Sequence[Layer]) -> tuple[float, float]:
    """Shares of a normal beam on the first layer that come back from it and leave the last one, scattered or not."""
    nodes, weights = radau()
    stacks = [doubled(layer, nodes, weights) for layer in layers]
    whole = functools.reduce(Stack.on, stacks)
    flux = weights * nodes
    return float(flux @ whole.reflected[:, -1] / flux[-1]), float(flux @ whole.passed[:, -1] / flux[-1])
