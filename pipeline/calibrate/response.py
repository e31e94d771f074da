"""The response of a camera that is not linear, from a bracket of exposures of one still scene (thesis 4.3).

Debevec and Malik 1997 and Robertson et al. 1999 fit the inverse, exposure by digital number, to digital numbers that
are noisy themselves; the dark end then comes out wrong by what the noise is to the signal. Here the response itself is
fitted, digital number by exposure, with every pixel's radiance, by weighted least squares: a maximum-likelihood fit
whose covariance is its uncertainty. The Lars III needs none of it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from hw.base.arrays import F64, I64, U16
from hw.base.errors import InputError
from hw.base.outcome import Ended, Outcome
from hw.record import Sensor

log = logging.getLogger(__name__)

KNOTS = (np.arange(21) / 20) ** 2  # of the spline, as shares of the full well: dense in the dark, where it bends
TABLE = 257  # entries of the inverse
PIXELS = 4000  # at most, of all brightnesses, that the fit looks at
FULL = 0.95  # of the full well: brighter ones may be clipped
LEAST = 20  # observations between any two knots
POWERS = np.linspace(1.0, 3.0, 9)  # of the gamma curve that the fit starts from
STEPS = 30
REWEIGHTED = 8  # of them that weigh anew; later a pixel or two would pass FULL to and fro for ever
MODEL_CHI2, SIGMAS = 1.2, 5.0  # what a spline and a noise model may leave per degree of freedom; and chance beyond it


@dataclass(frozen=True)
class Response:
    """exposure: (TABLE,) share of the full well that an evenly spaced share of the digital range stands for, 0 to 1;
    error: (TABLE,) its standard deviation; chi2: of the fit, per degree of freedom
    """

    exposure: F64
    error: F64
    chi2: float


def fit_response(images: Sequence[U16], seconds: Sequence[float], sensor: Sensor) -> Response:
    """images: (K, H, W) digital numbers of a still scene, each exposed for its time. The full well's charge stands for
    the largest digital number, the offset for none; dark current counts as light of the scene.

    Raises: InputError for a bracket that is not one, leaves a part of the response open, or fits no steady light.
    """
    if (
        len(images) < 2
        or len(images) != len(seconds)
        or len({np.size(i) for i in images}) > 1
        or not np.size(images[0])
    ):
        raise InputError(
            "a bracket is two or more images of one size, each with its time",
            key="bracket",
            value=[np.size(i) for i in images],
            remedy="take the bracket again",
        )
    span = sensor.saturation_dn - sensor.offset_dn
    time = np.asarray(seconds, np.float64) / max(seconds)
    seen = (np.stack([np.ravel(i) for i in images], axis=1).astype(np.float64) - sensor.offset_dn) / span
    _require_greys(seen)
    seen = seen[_spread(seen)]
    values, light = _start(seen, time)
    free = slice(1, len(KNOTS) - 1)  # none is nothing, and full is full: the scale is the white balance's
    damping, best = 1e-3, np.inf
    fit = _Equations.of(seen, time, values, light, sensor)
    for taken in range(STEPS):
        step, pull = fit.solve(damping)
        ahead, lit = values.copy(), np.maximum(light + pull, 1e-6)
        ahead[free] += step
        rest = seen - _curve(ahead)(_exposure(time, lit))
        cost = float((fit.weight * rest**2).sum())
        if cost < fit.cost:
            values, light, damping = ahead, lit, damping / 5
            if fit.cost - cost < 1e-7 * cost and abs(best - cost) < 1e-6 * cost:
                break
            best = cost
            fit = _Equations.of(seen, time, values, light, sensor, fit.weight if taken >= REWEIGHTED else None)
        else:
            damping *= 10
    else:  # whether it serves, chi^2 says below
        Ended(Outcome.STOPPED, STEPS).warn(log, "the fit of the response")
    fit = _Equations.of(seen, time, values, light, sensor)
    _require_cover(time * light[:, None])
    freedom = max(int((fit.weight > 0).sum()) - len(seen) - len(KNOTS) + 2, 1)
    chi2 = fit.cost / freedom
    _require_steady(chi2, freedom)
    covariance = np.linalg.inv(fit.reduced())
    dense = np.linspace(0, 1, 8 * TABLE) ** 2
    curve = _curve(values)
    rising = np.maximum.accumulate(curve(dense))
    exposure = np.interp(np.linspace(0, 1, TABLE), rising, dense)
    basis = _curve(np.eye(len(KNOTS)))(exposure)[:, free]
    spread = np.sqrt(np.einsum("ni,ij,nj->n", basis, covariance, basis))
    slope = np.maximum(curve(exposure, 1), 1e-6)
    return Response(exposure, np.sqrt(max(chi2, 1.0)) * spread / slope, chi2)


def _curve(values: F64) -> CubicSpline:
    """Digital number by exposure, both as shares; (M,) values at the knots, or (M, N) of N curves."""
    return CubicSpline(KNOTS, values, bc_type="natural")


def _exposure(time: F64, light: F64) -> F64:
    """(P, K) shares of the full well."""
    return np.minimum(light[:, None] * time, 1.0)


@dataclass(frozen=True)
class _Equations:
    """Normal equations of P pixels' radiances and M free knots: the radiances' block is diagonal.

    own: (P,), mixed: (P, M), shared: (M, M); right_own: (P,), right_shared: (M,); weight: (P, K)
    """

    own: F64
    mixed: F64
    shared: F64
    right_own: F64
    right_shared: F64
    weight: F64
    cost: float

    @classmethod
    def of(cls, seen: F64, time: F64, values: F64, light: F64, sensor: Sensor, weight: F64 | None = None) -> _Equations:
        """seen: (P, K) shares of the digital range; light: (P,) share of the full well at the longest exposure."""
        exposure, curve = _exposure(time, light), _curve(values)
        predicted, slope = curve(exposure), curve(exposure, 1)
        if weight is None:
            well = (sensor.saturation_dn - sensor.offset_dn) * sensor.gain_e_per_dn
            electrons = exposure * well + sensor.read_noise_e**2
            count = 1.0 / (sensor.saturation_dn - sensor.offset_dn)
            variance = np.maximum(slope, 1e-3) ** 2 * electrons / well**2 + count**2 / 12
            weight = np.where(light[:, None] * time < FULL, 1.0 / variance, 0.0)
        rest = seen - predicted
        basis = _curve(np.eye(len(KNOTS)))(exposure)[:, :, 1:-1]
        heavy = (basis * np.sqrt(weight)[:, :, None]).reshape(-1, basis.shape[2])
        by_light = slope * time
        return cls(
            (weight * by_light**2).sum(axis=1),
            np.einsum("pk,pkm->pm", weight * by_light, basis),
            heavy.T @ heavy,
            (weight * by_light * rest).sum(axis=1),
            np.einsum("pk,pkm->m", weight * rest, basis),
            weight,
            float((weight * rest**2).sum()),
        )

    def reduced(self, damping: float = 0.0) -> F64:
        """(M, M) information on the knots when the radiances are unknown."""
        own = np.maximum(self.own * (1 + damping), 1e-12)
        diagonal = np.diag(self.shared)
        # A knot that no pixel shows stays where it is until `_require_cover` names it.
        shared = self.shared + np.diag(damping * diagonal + np.where(diagonal > 0, 0.0, 1.0))
        return np.asarray(shared - (self.mixed / own[:, None]).T @ self.mixed)

    def solve(self, damping: float) -> tuple[F64, F64]:
        """(M,) and (P,) steps (Levenberg and Marquardt)."""
        own = np.maximum(self.own * (1 + damping), 1e-12)
        right = self.right_shared - self.mixed.T @ (self.right_own / own)
        knots = np.asarray(np.linalg.solve(self.reduced(damping), right), np.float64)
        return knots, np.asarray((self.right_own - self.mixed @ knots) / own)


def _require_steady(chi2: float, freedom: int) -> None:
    """Refuse a bracket whose images do not fit one scene and one response; a lamp that flickers by 1 % does that.

    Its error is one number for a whole image, which no number of pixels averages out and no covariance here contains.
    """
    most = MODEL_CHI2 + SIGMAS * float(np.sqrt(2.0 / freedom))
    if not chi2 <= most:
        raise InputError(
            "the exposures do not fit one still scene under steady light",
            key="bracket chi2",
            value=round(float(chi2), 2),
            allowed=f"up to {most:.2f}",
            remedy="steady light (let the lamp warm up) and a still board; take the bracket again",
        )


def _spread(seen: F64) -> I64:
    """Pixels of all brightnesses: as many of each, by how bright they are over all exposures."""
    brightness = np.clip(seen, 0.0, 1.0).sum(axis=1)
    bins = np.digitize(brightness, np.linspace(brightness.min(), brightness.max() + 1e-9, 41)) - 1
    rng, per_bin = np.random.default_rng(0), PIXELS // 40
    chosen = [rng.permutation(np.flatnonzero(bins == b))[:per_bin] for b in range(40)]
    return np.sort(np.concatenate(chosen))


def _start(seen: F64, time: F64) -> tuple[F64, F64]:
    """Knots and radiances by the gamma curve under which a pixel's exposures agree best."""
    usable = (seen > 0.05) & (seen < FULL)
    best = np.inf
    values, light = KNOTS, np.ones(len(seen))
    for power in POWERS:
        shown = np.where(usable, np.clip(seen, 1e-4, 1.0) ** power / time, np.nan)
        some = usable.sum(axis=1) >= 2
        relative = np.nanstd(shown[some], axis=1) / np.nanmean(shown[some], axis=1)
        spread = float(np.median(relative)) if len(relative) else 0.0
        if spread < best:
            # The longest exposure that is not clipped shows most; where all are, or none shows anything, a guess.
            last = np.where(usable.any(axis=1), np.argmax(np.where(usable, time, 0.0), axis=1), np.argmin(time))
            level = np.clip(np.take_along_axis(seen, last[:, None], axis=1)[:, 0], 1e-4, 1.0) ** power / time[last]
            best, light = spread, np.asarray(level, np.float64)
            values = np.asarray(0.02 * KNOTS + 0.98 * KNOTS ** (1 / power), np.float64)
    return values, light


def _require_greys(seen: F64) -> None:
    """Refuse a bracket in which hardly any pixel shows light that is not clipped in two exposures or more."""
    shown = int((((seen > 0.01) & (seen < FULL)).sum(axis=1) >= 2).sum())
    if shown < LEAST:
        raise InputError(
            f"the exposures do not cover the response: {shown} of {len(seen)} pixels are neither dark nor clipped in "
            "two of them",
            key="bracket",
            allowed=f"{LEAST} or more",
            remedy="more light, a shorter sensor.longest_exposure_s or more sensor.steps; a board with black and white",
        )


def _require_cover(exposure: F64) -> None:
    """Refuse a bracket that leaves a part of the response open."""
    count = np.histogram(exposure[exposure < FULL], KNOTS[KNOTS < FULL])[0]
    if count.min() < LEAST:
        open_at = int(np.argmin(count))
        raise InputError(
            f"the exposures do not cover the response between {KNOTS[open_at]:.2g} and {KNOTS[open_at + 1]:.2g} of the "
            "full well",
            key="bracket",
            remedy="raise sensor.steps or sensor.longest_exposure_s, or light the board more; take the bracket again",
        )
