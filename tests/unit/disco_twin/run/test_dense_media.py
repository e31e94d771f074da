"""Media so dense that light turns back within a small part of a cell of the diffusion estimate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scene_texts import GOOD

from disco_twin.evaluate.simulation_noise import coarse_estimate, lit_vertices
from disco_twin.experiment.experiment import Experiment
from disco_twin.light.importance import Diffusion, window_targets
from disco_twin.light.truth import places_of
from disco_twin.object import shapes
from disco_twin.object.mesh import hat_basis
from disco_twin.run.cost_prediction import copies_at_start, duration
from disco_twin.scene.scene import load_scene

# Share of a normal beam that a half-space of index 1.3 absorbs: all but the specular and the diffuse reflectance.
ABSORBED = {0.9: 1 - 0.017013 - 0.285783, 0.99: 1 - 0.017013 - 0.645394, 0.999: 1 - 0.017013 - 0.856754}


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shapes, "SUBDIVISIONS", 4)


def ball(folder: Path, sigma_t: float, albedo: float) -> Experiment:
    """A ball of 20 mm of one medium."""
    path = folder / "scene.toml"
    feature = '[[object.medium.features]]\nkind = "hollow"\nradius_mm = 3.0\n'
    text = GOOD.replace(feature, "").replace("sigma_t_per_mm = 1.6", f"sigma_t_per_mm = {sigma_t}")
    path.write_text(text.replace("[0.9, 0.8, 0.7]", str(albedo)).replace("vertices = 642", "vertices = 150"))
    return Experiment(load_scene(path))


@pytest.mark.parametrize("sigma_t", [30.0, 300.0, 1e4])
def test_collisions_are_those_of_a_half_space(sigma_t: float, tmp_path: Path) -> None:
    """Rationale: `plan` reckons a walk's time from its collisions; however dense the medium is, light that is absorbed
    within a cell is scattered as often as in a half-space.

    Expected behaviour: within a quarter of the exact number, absorbed share / (1 - albedo).
    """
    for albedo, absorbed in ABSORBED.items():
        experiment = ball(tmp_path, sigma_t, albedo)
        places = experiment.scan.vertices[lit_vertices(experiment)]
        found = coarse_estimate(experiment).collisions(places)
        assert found == pytest.approx(absorbed / (1 - albedo), rel=0.25), albedo


@pytest.mark.parametrize("sigma_t", [3.0, 300.0, 1e4])
def test_photons_do_not_burst_where_light_enters(sigma_t: float, tmp_path: Path) -> None:
    """Rationale: light enters over a whole hat function. Windows for its middle alone took what entered beside it for
    light that had come from there, and split it a thousandfold: truth did not end above some 100 mean free paths a mm.

    Expected behaviour: at the start, photons are split into fewer copies than `effort` allows collisions.
    """
    experiment = ball(tmp_path, sigma_t, 0.99)
    estimate, mesh, columns = coarse_estimate(experiment), experiment.object.mesh, lit_vertices(experiment)
    hats = hat_basis(mesh, experiment.scan)[:, columns].toarray().T
    places = places_of(hats, mesh)
    targets = window_targets(estimate.fluence(places), estimate.filled, 3.0)[:, estimate.filled]
    copies = [(1 / target[estimate.unknowns(at)]).mean() for target, at in zip(targets, places, strict=True)]
    assert max(copies) < 3
    assert copies_at_start(experiment) < 3


def test_half_a_cell_keeps_all_light() -> None:
    """Rationale: the analytic slab between surface and the cell's middle, with next to no absorption and with much.

    Expected behaviour: what reaches the middle, leaks, and is absorbed adds up; a source in the middle is all there.
    """
    a, s = np.array([1e-9, 0.05, 2.0, 0.01]), np.array([10.0, 10.0, 100.0, 0.5])
    estimate = Diffusion(np.ones((1, 1, 1), bool), np.zeros((1, 1, 1), int), np.zeros(3), 1.0, None, a + s, a, s, 0.25)
    reached, flown = estimate.below_surface(np.arange(4))
    z = np.linspace(0, 0.5, 200_001)
    for k in range(3):
        d, start = 1 / (3 * (a[k] + s[k])), 1 / (a[k] + s[k])
        if k == 0:  # without absorption light divides as current does between two resistances
            out, deep = 1 / 0.25 + start / d, (0.5 - start) / d
            assert reached[k] == pytest.approx(out / (out + deep), rel=1e-4)
            peak = out * deep / (out + deep)
            assert flown[k] == pytest.approx(peak * (start * (1 - start / d / 2 / out) + (0.5 - start) / 2), rel=1e-2)
        else:
            kappa = np.sqrt(a[k] / d)
            below = np.cosh(kappa * z) + 0.25 / kappa / d * np.sinh(kappa * z)
            above = np.sinh(kappa * (0.5 - z))
            i = np.searchsorted(z, start)
            wronskian = (
                d * kappa * (below[i] * np.cosh(kappa * (0.5 - z[i])) + above[i] * np.gradient(below, z)[i] / kappa)
            )
            fluence = np.where(z < start, below * above[i], above * below[i]) / wronskian
            assert flown[k] == pytest.approx(np.trapezoid(fluence, z), rel=1e-3)
            assert reached[k] == pytest.approx(d * kappa * below[i] / wronskian, rel=1e-3)
    assert reached[3] == 1 and flown[3] == pytest.approx(0, abs=1e-9)


def test_what_single_precision_does_is_told(tmp_path: Path) -> None:
    assert not any("single precision" in line for line in ball(tmp_path, 1000.0, 0.9).warnings)
    (line,) = [line for line in ball(tmp_path, 1e4, 0.9).warnings if "single precision" in line]
    assert "0.0001 mm" in line and "about 2 %" in line and "Remedy: " in line and "\n" not in line


def test_long_times_are_told_in_words() -> None:
    assert [duration(s) for s in (3.0, 90.0, 6000.0, 4e6)] == [
        "less than .1 minutes", "about 1.5 minutes", "about 1.7 hours", "about 46.3 days"
    ]  # fmt: skip
