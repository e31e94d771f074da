"""A half-space with a known answer."""

from __future__ import annotations

from twins import block, twin

from disco_twin.object.build import TwinObject

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
