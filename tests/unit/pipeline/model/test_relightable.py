"""The model's sum, its file, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.relight.lights import Directional
from pipeline.relight.on_mesh import ViewOfMesh

MESH = trimesh.creation.icosphere(subdivisions=1, radius=15.0)
V = len(MESH.vertices)
BOUNDARY = Boundary(1.3, (0.1, 0.9), (1.2, 1.0))
CAMERA = PinholeCamera(
    32, 24, np.array([300.0, 300.0]), np.array([16.0, 12.0]), np.zeros(5), look_at((300, 80, 40), (0, 0, 0))
)


def dense(seed: int = 0, variance: bool = True) -> GlobalTerm:
    draw = np.random.default_rng(seed).random((2, V, V)).astype(np.float32)
    r = (draw + draw.transpose(0, 2, 1)) * 1e-3
    return GlobalTerm(r, r[0] > 1e-3, r * 1e-4 if variance else None)


def opaque() -> LambertianTerm:
    return LambertianTerm(np.random.default_rng(5).random((2, V)).astype(np.float32))


def model(*terms: GlobalTerm | LambertianTerm) -> RelightableModel:
    return RelightableModel(MESH, BOUNDARY, terms, {"method": "test"})


def picture(of: RelightableModel) -> np.ndarray:
    return of.image(of.lit_by(Directional(direction=(-1, 0.3, 0))), of.seen_by(CAMERA))


def test_the_image_is_the_sum_of_the_terms() -> None:
    """Rationale: light adds up; so do R_d and its variance, and an opaque term has no part in R_d between points."""
    parts = (dense(0), opaque(), dense(1))
    total = picture(model(*parts))
    assert total.shape == (2, 24, 32)
    np.testing.assert_allclose(total, sum(picture(model(part)) for part in parts), atol=1e-6 * total.max())
    assert picture(model(opaque())).max() > 0.05 * total.max()
    columns = model(*parts).reflectance_columns([3, 5])
    assert columns is not None
    assert columns.variance is not None
    np.testing.assert_allclose(columns.mean, (parts[0].reflectance + parts[2].reflectance)[:, [3, 5]])
    np.testing.assert_allclose(columns.variance, (parts[0].variance + parts[2].variance)[:, [3, 5]])
    np.testing.assert_array_equal(columns.measured, (parts[0].measured | parts[2].measured)[[3, 5]])
    assert model(opaque()).reflectance_columns([3]) is None
    unsure = model(dense(), dense(variance=False)).reflectance_columns([3])
    assert unsure is not None
    assert unsure.variance is None


def test_a_lambertian_surface_is_a_diagonal_matrix() -> None:
    """Rationale: R_d = albedo / area at distance 0 relights the same; only the numbers' rounding differs."""
    term = opaque()
    diagonal = np.zeros((2, V, V), np.float32)
    for laser in range(2):
        np.fill_diagonal(diagonal[laser], term.albedo[laser] / RayMesh.of(MESH).vertex_areas)
    one, other = picture(model(term)), picture(model(GlobalTerm(diagonal, diagonal[0] > 0)))
    np.testing.assert_allclose(one, other, atol=1e-6 * other.max())
    assert other.max() > 0


def test_what_leaves_is_tbar_squared_times_throughput() -> None:
    """Rationale: Tbar of light arriving from all directions enters; of what comes up, Tbar leaves; a Lambertian part
    gives back where it was lit.
    """
    term, albedo, area = dense(), opaque(), RayMesh.of(MESH).vertex_areas
    both = BOUNDARY.mean_transmittance**2
    assert both > Boundary(1.3).mean_transmittance ** 2
    leaving = model(term, albedo).leaving([3, 5], area)
    assert leaving is not None
    expected = both * term.reflectance[:, [3, 5]] * area
    for n, u in enumerate([3, 5]):
        expected[:, n, u] += both * albedo.albedo[:, u]
    np.testing.assert_allclose(leaving, expected, rtol=1e-6)
    columns = model(term, albedo).exitance_columns([3, 5])
    assert columns is not None
    np.testing.assert_allclose(columns.mean, both * term.reflectance[:, [3, 5]], rtol=1e-6)
    np.testing.assert_allclose(columns.variance, both**2 * term.variance[:, [3, 5]], rtol=1e-6)
    assert model(albedo).exitance_columns([3]) is None


def test_the_variance_of_an_image_is_that_of_its_entries() -> None:
    """Rationale: models drawn from the stated variances, every entry apart or all together. Expected: the scatter of
    their images.
    """
    term, rng = dense(), np.random.default_rng(1)
    of = model(term)
    light, view = of.lit_by(Directional(direction=(-1, 0.3, 0))), of.seen_by(CAMERA)
    stated = of.image_variance(light, view)
    assert stated is not None
    assert stated.shape == (2, 2, 24, 32)
    deviation = np.sqrt(term.variance)
    draws = [light.flux[:, None] @ (deviation * rng.standard_normal(deviation.shape)) for _ in range(400)]
    scatter = np.var([view.image(d[:, 0]) for d in draws], axis=0)
    shown = stated[0] > 1e-3 * stated[0].max()
    assert np.median(scatter[shown] / stated[0][shown]) == pytest.approx(1, abs=0.05)
    together = view.image((np.abs(light.flux)[:, None] @ deviation)[:, 0])  # all of one sign
    np.testing.assert_allclose(stated[1], together**2, rtol=1e-4, atol=1e-6 * stated[1].max())
    assert (stated[1] >= stated[0] * (1 - 1e-5)).all()
    twice = model(term, term).image_variance(light, view)
    np.testing.assert_allclose(twice, np.stack([2 * stated[0], 4 * stated[1]]), rtol=1e-5)
    assert model(opaque()).image_variance(light, view) is None
    assert model(term, opaque()).image_variance(light, view) is None


def test_a_file_gives_the_same_model(tmp_path: Path) -> None:
    made = model(dense(), opaque(), dense(1, variance=False))
    made.save(tmp_path / "model.npz")
    again = RelightableModel.load(tmp_path / "model.npz")
    assert [term.kind for term in again.terms] == ["global", "lambertian", "global"]
    assert (again.boundary, again.provenance, again.lasers) == (BOUNDARY, {"method": "test"}, 2)
    for term, kept in zip(made.terms, again.terms, strict=True):
        assert term.arrays().keys() == kept.arrays().keys()
        for name, array in term.arrays().items():
            np.testing.assert_array_equal(kept.arrays()[name], array)
            assert kept.arrays()[name].dtype == array.dtype
    np.testing.assert_array_equal(picture(again), picture(made))


def test_lasers_are_chosen_in_every_term() -> None:
    term, albedo = dense(), opaque()
    chosen = model(term, albedo).of_lasers([1, 0, 1])
    assert chosen.lasers == 3
    np.testing.assert_array_equal(chosen.terms[0].arrays()["reflectance"], term.reflectance[[1, 0, 1]])
    np.testing.assert_array_equal(chosen.terms[0].arrays()["measured"], term.measured)
    np.testing.assert_array_equal(chosen.terms[1].arrays()["albedo"], albedo.albedo[[1, 0, 1]])


def test_terms_that_do_not_fit_are_refused() -> None:
    term = dense()
    with pytest.raises(ValueError, match=r"global.variance: has the shape \(2, 42, 5\), not \(laser 2, vertex 42, ver"):
        model(GlobalTerm(term.reflectance, term.measured, term.variance[:, :, :5]))
    with pytest.raises(ValueError, match="albedo: holds values that are not finite"):
        model(LambertianTerm(np.full((2, V), np.nan, np.float32)))
    with pytest.raises(ValueError, match="laser 2"):
        model(term, LambertianTerm(np.ones((3, V), np.float32)))
    for held in (term.measured.astype(np.float32), term.measured.astype(int)):
        with pytest.raises(ValueError, match=r"global.measured: holds (float32|int64), not kind 'b'"):
            model(GlobalTerm(term.reflectance, held))
    with pytest.raises(ValueError, match=r"global.reflectance: holds <U\d+, not kind 'f'"):
        model(GlobalTerm(term.reflectance.astype(str), term.measured))
    with pytest.raises(ValueError, match="at least one term"):
        model()


def test_a_matrix_that_is_not_symmetric_is_refused() -> None:
    """Rationale: columns of R_d are read as rows. What rounding leaves (1e-7 of an entry) is no asymmetry."""
    term = dense()
    for name, array in term.arrays().items():
        bent = array.copy()
        bent[..., 3, 5] = ~bent[..., 3, 5] if array.dtype == bool else 1.01 * bent[..., 3, 5]
        with pytest.raises(ValueError, match=f"global.{name}: is not symmetric"):
            model(GlobalTerm(**(term.arrays() | {name: bent})))
    rounded = np.triu(np.nextafter(term.reflectance, np.float32(1))) + np.tril(term.reflectance, -1)
    assert (rounded != rounded.transpose(0, 2, 1)).any()
    model(GlobalTerm(rounded, term.measured))


def test_the_same_surface_loaded_twice_shares_lights_and_views(tmp_path: Path) -> None:
    made = model(dense())
    made.save(tmp_path / "model.npz")
    one, two = (RelightableModel.load(tmp_path / "model.npz") for _ in range(2))
    light, view = one.lit_by(Directional(direction=(-1, 0.3, 0))), one.seen_by(CAMERA)
    np.testing.assert_array_equal(two.image(light, view), picture(made))
    with pytest.raises(ValueError, match="prepared for 2 lasers, not 3"):
        one.of_lasers([0, 1, 0]).image(light, view)
    moved = RelightableModel(MESH.copy().apply_translation([1e-6, 0, 0]), BOUNDARY, (dense(),))
    with pytest.raises(ValueError, match="another mesh or boundary"):
        moved.image(light, view)


def test_a_lights_radiosity_serves_all_views(monkeypatch: pytest.MonkeyPatch) -> None:
    of, drawn = model(dense()), []
    monkeypatch.setattr(ViewOfMesh, "image", lambda view, radiosity: drawn.append(radiosity) or radiosity)
    lights = [of.lit_by(Directional(direction=(-1, y, 0))) for y in (0.3, 0.4)]
    for light in lights:
        for _ in range(2):
            of.image(light, of.seen_by(CAMERA))
    assert np.shares_memory(drawn[0], drawn[1])
    assert np.shares_memory(drawn[2], drawn[3])
    for radiosity, light in zip(drawn[::2], lights, strict=True):
        expected = np.einsum("lu,luv->lv", light.flux, of.terms[0].reflectance)
        np.testing.assert_allclose(radiosity, expected, rtol=1e-12)


def test_what_was_prepared_for_another_surface_is_refused() -> None:
    mine, other = model(dense()), RelightableModel(MESH, Boundary(1.3), (dense(),))
    with pytest.raises(ValueError, match="another mesh or boundary"):
        mine.image(other.lit_by(Directional(direction=(-1, 0, 0))), mine.seen_by(CAMERA))
    with pytest.raises(ValueError, match="another mesh or boundary"):
        mine.image(mine.lit_by(Directional(direction=(-1, 0, 0))), other.seen_by(CAMERA))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"format_version": 1}, "another format"),
        ({"format_version": 3}, "another format"),
        ({"terms": ["texel"]}, "unknown kind of term"),
        ({"terms": ["lambertian"]}, "is damaged"),
        ({"terms": []}, "unknown units"),
        ({"units": {}}, "unknown units"),
        ({"boundary": {"eta": "thick", "cosines": [], "ratio": []}}, "is damaged"),
        ({"term0.variance": np.zeros((2, V, 5), np.float32)}, "has the shape"),
        ({"faces": np.array([[0, 1, 2000]])}, "is damaged"),
        ({"term0.reflectance": None}, "is damaged"),
    ],
)
def test_other_files_are_refused_in_one_line(change: dict[str, object], expected: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    model(dense()).save(path)
    with np.load(path) as data:
        arrays = dict(data)
    head = json.loads(str(arrays.pop("head")))
    head |= {k: v for k, v in change.items() if k in head}
    arrays = {k: change.get(k, array) for k, array in arrays.items()}
    np.savez(path, head=np.array(json.dumps(head)), **{k: array for k, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=expected) as caught:
        RelightableModel.load(path)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


def test_other_things_are_no_models(tmp_path: Path) -> None:
    good = tmp_path / "model.npz"
    model(dense()).save(good)
    (tmp_path / "cut.npz").write_bytes(good.read_bytes()[:5000])
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "old.npz", head=np.array('{"format_version": 1, "units": {}}'), reflectance=np.zeros((1, 3, 3)))
    for name in ("cut.npz", "text.npz", "old.npz", "none.npz"):
        with pytest.raises(InputError, match=name) as caught:
            RelightableModel.load(tmp_path / name)
        assert "\n" not in str(caught.value)
