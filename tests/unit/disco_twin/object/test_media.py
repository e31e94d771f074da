"""Media: materials, features against closed forms, voxel files and their refusals."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from disco_twin.object import shapes
from disco_twin.object.media import Medium, build_medium, cell_centres
from disco_twin.object.mesh import depth
from disco_twin.scene.object_schema import MediumConfig
from disco_twin.scene.shape_schema import Box, Sphere
from hw.base.config import check
from hw.base.errors import InputError

RGB = (635.0, 532.0, 476.0)
BASE = {"kind": "homogeneous", "sigma_t_per_mm": 1.0, "albedo": [0.9, 0.8, 0.7]}
SPHERE = shapes.sphere(Sphere(kind="sphere", radius_mm=10.0))
BOX = shapes.box(Box(kind="box", size_mm=(20.0, 16.0, 12.0)))


def medium(mesh: trimesh.Trimesh = BOX, folder: Path = Path(), base: Any = None, **more: Any) -> Medium:
    config = check({"base": base or BASE, **more}, MediumConfig, folder / "scene.toml")
    return build_medium(config, mesh, RGB)


def share(built: Medium, value: float, background: float = 1.0) -> np.ndarray:
    """(nz, ny, nx) share of each voxel that a feature with sigma_t = `value` covers."""
    return (built.sigma_t[0].astype(float) - background) / (value - background)


def volume(built: Medium) -> float:
    return float(np.prod((built.high - built.low) / built.sigma_t.shape[:0:-1]))


# ---------------------------------------------------------------- bases
def test_homogeneous_is_one_cell() -> None:
    built = medium(g=[0.1, 0.2, 0.3])
    assert built.sigma_t.shape == built.albedo.shape == (3, 1, 1, 1)
    assert built.sigma_t.dtype == built.albedo.dtype == np.float32
    np.testing.assert_allclose(built.albedo.ravel(), [0.9, 0.8, 0.7], rtol=1e-6)
    assert built.g == (0.1, 0.2, 0.3)


def test_marble_is_jensens_marble() -> None:
    built = medium(base={"kind": "material", "name": "marble"})
    sigma_s = built.sigma_t * built.albedo
    np.testing.assert_allclose(sigma_s.ravel(), [2.19, 2.62, 3.00], rtol=1e-6)
    np.testing.assert_allclose((built.sigma_t - sigma_s).ravel(), [0.0021, 0.0041, 0.0071], rtol=1e-3)


def test_one_laser_takes_the_nearest_channel() -> None:
    config = MediumConfig.model_validate({"base": {"kind": "material", "name": "ketchup"}})
    built = build_medium(config, BOX, [520.0])
    assert built.sigma_t.ravel() == pytest.approx([0.07 + 0.97])


def test_materials_refuse_what_they_do_not_know() -> None:
    with pytest.raises(InputError, match=r"unknown material 'marbel'.*marble, skin1"):
        medium(base={"kind": "material", "name": "marbel"})
    with pytest.raises(InputError, match="needs g = 0"):
        medium(base={"kind": "material", "name": "marble"}, g=0.5)


# ---------------------------------------------------------------- features
def test_grid_covers_the_object_with_a_margin() -> None:
    built = medium(cell_mm=0.7, features=[{"kind": "hollow", "radius_mm": 2.0}])
    cell = (built.high - built.low) / np.array(built.sigma_t.shape[:0:-1])
    np.testing.assert_allclose(cell, 0.7)
    assert (built.low <= BOX.bounds[0] - 0.35).all()  # no cell centre inside is an outermost one
    assert (built.high >= BOX.bounds[1] + 0.35).all()


def test_hollow_core_has_the_volume_of_its_ball() -> None:
    """Soft edges are symmetric about the surface: volume right to second order in cell / radius."""
    built = medium(cell_mm=0.4, features=[{"kind": "hollow", "radius_mm": 4.0, "centre_mm": [1.0, 0.5, 0.0]}])
    assert share(built, 0.0).sum() * volume(built) == pytest.approx(4 / 3 * np.pi * 4**3, rel=0.01)
    assert built.sigma_t.min() == 0
    assert np.isfinite(built.albedo).all()


@pytest.mark.parametrize("cell", [0.25, 1.0])
def test_thin_crack_keeps_its_optical_thickness(cell: float) -> None:
    """A ray across a 0.5 mm sheet of sigma_t 9 sees 0.5 * (9 - 1) more than without it, voxels fine or coarse."""
    crack = {"kind": "crack", "sigma_t_per_mm": 9.0, "normal": [1, 0, 0], "width_mm": 0.5, "waviness_mm": 0.0}
    built = medium(cell_mm=cell, features=[{**crack, "radius_mm": 4.0, "through_mm": [0.3, 0.0, 0.0]}])
    middle = built.sigma_t[0, built.sigma_t.shape[1] // 2, built.sigma_t.shape[2] // 2].astype(float)
    assert (middle - 1.0).sum() * cell == pytest.approx(0.5 * 8.0, rel=1e-5)
    edge = built.sigma_t[0, built.sigma_t.shape[1] // 2, 0]
    np.testing.assert_allclose(edge, 1.0)  # 8 mm away from the middle: outside the disc


def test_layers_cover_their_share() -> None:
    layers = {"kind": "layers", "sigma_t_per_mm": 3.0, "albedo": 0.5, "period_mm": 4.0, "share": 0.25}
    built = medium(cell_mm=0.25, features=[{**layers, "direction": [0, 0, 2]}])
    z = cell_centres(built.low, built.high, built.sigma_t.shape[1:])[:, 2].reshape(built.sigma_t.shape[1:])
    inside = np.abs((z % 4.0) - 0.5) < 0.5 - 0.13
    outside = (z % 4.0 > 1.13) & (z % 4.0 < 3.87)
    np.testing.assert_allclose(built.sigma_t[0][inside], 3.0, rtol=1e-6)
    np.testing.assert_allclose(built.sigma_t[0][outside], 1.0, rtol=1e-6)
    np.testing.assert_allclose(built.albedo[0][inside], 0.5, rtol=1e-6)


def test_veins_are_sheets_of_their_width() -> None:
    """Halving the width halves the volume of thin sheets (crossings count once, so a little less than half is lost)."""
    veins = {"kind": "veins", "sigma_t_per_mm": 3.0, "albedo": 0.5, "spacing_mm": 8.0}
    covered = [share(medium(cell_mm=0.4, features=[{**veins, "width_mm": w}]), 3.0).mean() for w in (0.5, 1.0)]
    assert 1.8 < covered[1] / covered[0] < 2.05
    assert 0.05 < covered[1] < 0.6
    same, other = (medium(cell_mm=0.8, features=[{**veins, "seed": s}]).sigma_t for s in (1, 2))
    assert np.array_equal(same, medium(cell_mm=0.8, features=[veins]).sigma_t)
    assert not np.array_equal(same, other)


def test_patch_is_a_skin_of_its_depth() -> None:
    """On a sphere of 10 mm: painted to 1.5 mm below the surface near the pole, nothing deeper or further."""
    patch = {"kind": "patch", "centre_mm": [0, 0, 30], "radius_mm": 5.0, "depth_mm": 1.5, "sigma_t_per_mm": 5.0}
    built = medium(SPHERE, cell_mm=0.4, features=[patch])
    points = cell_centres(built.low, built.high, built.sigma_t.shape[1:])
    covered = share(built, 5.0).ravel()
    below = depth(SPHERE, points)
    away = np.linalg.norm(points - [0, 0, 10.0], axis=1)
    painted = (below < 1.5 - 0.25) & (away < 5.0 - 0.25)
    bare = (below > 1.5 + 0.25) | (away > 5.0 + 0.25)
    np.testing.assert_allclose(covered[painted], 1, atol=1e-6)
    np.testing.assert_allclose(covered[bare], 0, atol=1e-6)


def test_features_lie_over_one_another_in_order() -> None:
    first = {"kind": "hollow", "radius_mm": 3.0}
    second = {"kind": "layers", "sigma_t_per_mm": 2.0, "albedo": 0.5, "period_mm": 100.0, "share": 0.99}
    middle = tuple(n // 2 for n in medium(features=[first]).sigma_t.shape[1:])
    over = medium(features=[first, {**second, "offset_mm": -50.0}])
    under = medium(features=[{**second, "offset_mm": -50.0}, first])
    assert over.sigma_t[0][middle] == pytest.approx(2.0)
    assert under.sigma_t[0][middle] == 0


def test_mixing_keeps_energy_shares() -> None:
    """A voxel half covered has the mean sigma_s and the mean sigma_a, not the mean albedo."""
    layers = {"kind": "layers", "sigma_t_per_mm": 3.0, "albedo": 0.0, "period_mm": 4.0, "share": 0.5}
    built = medium(cell_mm=0.5, features=[layers])
    sigma_s = (built.sigma_t * built.albedo)[0].astype(float)
    w = share(built, 3.0)
    np.testing.assert_allclose(sigma_s, (1 - w) * 0.9, atol=1e-6)


def test_features_outside_and_too_many_voxels_are_refused() -> None:
    with pytest.raises(InputError, match=r"features\[0\].*hollow lies outside the object"):
        medium(features=[{"kind": "hollow", "radius_mm": 2.0, "centre_mm": [90, 0, 0]}])
    with pytest.raises(InputError, match=r"cell_mm = 0\.02.*larger voxels"):
        medium(cell_mm=0.02, features=[{"kind": "hollow", "radius_mm": 2.0}])


# ---------------------------------------------------------------- voxel files
CORNERS = {"low_mm": [-11, -9, -7], "high_mm": [11, 9, 7]}


def grid(folder: Path, values: Any, **more: Any) -> Medium:
    np.save(folder / "sigma_t.npy", values)
    base = {"kind": "grid", "sigma_t_file": "sigma_t.npy", "albedo": 0.9, **CORNERS, **more}
    return medium(folder=folder, base=base)


def test_npy_grids(tmp_path: Path) -> None:
    values = np.random.default_rng(0).uniform(0, 2, size=(4, 5, 6))
    built = grid(tmp_path, values)
    np.testing.assert_allclose(built.sigma_t, np.broadcast_to(values, (3, 4, 5, 6)), rtol=1e-6)
    np.testing.assert_allclose(built.albedo, 0.9, rtol=1e-6)
    np.testing.assert_allclose([built.low, built.high], [CORNERS["low_mm"], CORNERS["high_mm"]])
    built = grid(tmp_path, np.stack([values, 2 * values, 3 * values]))
    np.testing.assert_allclose(built.sigma_t[2], 3 * values, rtol=1e-6)
    np.save(tmp_path / "albedo.npy", values / 2)
    built = grid(tmp_path, values, albedo=None, albedo_file="albedo.npy")
    np.testing.assert_allclose(built.albedo[1], values / 2, rtol=1e-6)


def test_features_keep_a_grids_own_voxels(tmp_path: Path) -> None:
    np.save(tmp_path / "sigma_t.npy", np.ones((14, 18, 22)))
    base = {"kind": "grid", "sigma_t_file": "sigma_t.npy", "albedo": 0.9, **CORNERS}
    built = medium(folder=tmp_path, base=base, features=[{"kind": "hollow", "radius_mm": 3.0}])
    assert built.sigma_t.shape == (3, 14, 18, 22)
    assert built.sigma_t.min() == 0


def bad(value: float) -> np.ndarray:
    values = np.ones((4, 5, 6))
    values[1, 2, 3] = value
    return values


@pytest.mark.parametrize(
    ("values", "more", "message"),
    [
        (bad(np.nan), {}, r"z=1 y=2 x=3 .*not a finite number \(1 in all\)"),
        (bad(np.inf), {}, "not a finite number"),
        (bad(-1.0), {}, "z=1 y=2 x=3 .*negative"),
        (np.ones((2, 4, 5, 6)), {}, "2 wavelengths for 3 lasers"),
        (np.ones((5, 6)), {}, "not an array of real numbers"),
        (np.ones((0, 5, 6)), {}, "empty"),
        (np.ones((4, 5, 6), dtype=complex), {}, "not an array of real numbers"),
        (
            np.ones((4, 5, 6)),
            {"low_mm": [-9, -9, -7]},
            r"does not cover the object \(allowed: low_mm <= \(-10, -8, -6\)",
        ),
        (np.ones((4, 5, 6)), {"high_mm": [11, 9, 5]}, "does not cover the object"),
        (np.ones((4, 5, 6)), {"low_mm": None, "high_mm": None}, "required for a .npy grid"),
        (np.ones((4, 5, 6)), {"low_mm": None}, "both low_mm and high_mm"),
        (np.ones((4, 5, 6)), {"albedo": None}, "exactly one of albedo and albedo_file"),
    ],
)
def test_bad_grids(values: np.ndarray, more: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as caught:
        grid(tmp_path, values, **more)
    assert "\n" not in str(caught.value)


def test_bad_albedo_grids_and_files(tmp_path: Path) -> None:
    np.save(tmp_path / "albedo.npy", bad(1.25))
    with pytest.raises(InputError, match=r"albedo_file.*z=1 y=2 x=3 .*1\.25 .*0 \.\. 1"):
        grid(tmp_path, np.ones((4, 5, 6)), albedo=None, albedo_file="albedo.npy")
    np.save(tmp_path / "albedo.npy", np.ones((4, 5, 7)))
    with pytest.raises(InputError, match=r"albedo grid is \(4, 5, 7\), sigma_t is \(4, 5, 6\)"):
        grid(tmp_path, np.ones((4, 5, 6)), albedo=None, albedo_file="albedo.npy")
    for name, message in (("a.npy", "not a readable .npy"), ("a.vol", "not a Mitsuba .vol"), ("a.txt", "unknown type")):
        (tmp_path / name).write_text("no grid")
        with pytest.raises(InputError, match=message):
            grid(tmp_path, np.ones((4, 5, 6)), sigma_t_file=name)
    with pytest.raises(InputError, match="no such file"):
        grid(tmp_path, np.ones((4, 5, 6)), sigma_t_file="missing.npy")


@pytest.mark.skipif(find_spec("mitsuba") is None, reason="needs mitsuba")
@pytest.mark.parametrize("channels", [1, 3])
def test_vol_files_are_mitsubas(channels: int, tmp_path: Path) -> None:
    """Written by Mitsuba itself: order of axes and channels, and the bounding box in the file."""
    from disco_twin.light.backend import activate

    activate()
    import mitsuba as mi

    values = np.random.default_rng(1).uniform(0, 2, size=(4, 5, 6, channels)).astype(np.float32)
    volume = mi.VolumeGrid(values)
    volume.write(str(tmp_path / "grid.vol"))
    base = {"kind": "grid", "sigma_t_file": "grid.vol", "albedo": 0.5}
    with pytest.raises(InputError, match=r"from \(0, 0, 0\) to \(1, 1, 1\) mm does not cover.*set low_mm and high_mm"):
        medium(folder=tmp_path, base=base)
    built = medium(folder=tmp_path, base={**base, **CORNERS})
    np.testing.assert_allclose(built.sigma_t, np.broadcast_to(np.moveaxis(values, -1, 0), (3, 4, 5, 6)))
    data = bytearray((tmp_path / "grid.vol").read_bytes())
    data[24:48] = np.array([-11, -9, -7, 11, 9, 7], dtype="<f4").tobytes()
    (tmp_path / "grid.vol").write_bytes(bytes(data))
    built = medium(folder=tmp_path, base=base)
    np.testing.assert_allclose(built.high, [11, 9, 7])
    (tmp_path / "grid.vol").write_bytes(bytes(data[:-4]))
    with pytest.raises(InputError, match="its header states"):
        medium(folder=tmp_path, base=base)


# ---------------------------------------------------------------- asymmetry
LAYERS = {"kind": "layers", "sigma_t_per_mm": 3.0, "albedo": 0.5, "period_mm": 4.0}


def test_a_feature_has_an_asymmetry_of_its_own() -> None:
    """Voxels that it covers half keep the reduced scattering of both: lasers here differ in sigma_t."""
    base = {**BASE, "sigma_t_per_mm": [1.0, 2.0, 3.0]}
    own = {**LAYERS, "sigma_t_per_mm": [4.0, 5.0, 6.0], "g": [0.2, -0.3, 0.4]}
    built = medium(base=base, g=0.8, features=[own])
    assert built.g_voxels is not None and built.g_voxels.shape == built.sigma_t.shape
    w = medium(features=[LAYERS])
    w = share(w, 3.0)
    for k, (t, a, g) in enumerate(zip((1.0, 2.0, 3.0), (0.9, 0.8, 0.7), (0.2, -0.3, 0.4), strict=True)):
        reduced = (1 - w) * t * a * (1 - 0.8) + w * (t + 3.0) * 0.5 * (1 - g)
        found = (built.sigma_t * built.albedo * (1 - built.g_voxels))[k]
        np.testing.assert_allclose(found, reduced, rtol=1e-5)
        scattered = (built.sigma_t * built.albedo)[k].astype(float)
        assert built.g[k] == pytest.approx((scattered * built.g_voxels[k]).sum() / scattered.sum(), rel=1e-6)


def test_a_feature_without_one_has_the_mediums() -> None:
    built = medium(g=0.8, features=[LAYERS, {"kind": "hollow", "radius_mm": 2.0}, {**LAYERS, "g": 0.8}])
    assert built.g_voxels is None
    assert built.g == (0.8,) * 3


def test_lasers_that_differ_in_albedo_keep_one_walk() -> None:
    built = medium(g=0.8, features=[{**LAYERS, "albedo": [0.2, 0.5, 0.9], "g": 0.1}])
    assert built.groups() == ((0, 1, 2),)
    assert np.ptp(built.g_voxels) > 0.5
    apart = medium(g=0.8, features=[{**LAYERS, "g": [0.1, 0.1, 0.2]}])
    assert apart.groups() == ((0, 1), (2,))


def test_a_grid_of_asymmetries(tmp_path: Path) -> None:
    values = np.random.default_rng(0).uniform(-0.9, 0.9, size=(4, 5, 6))
    np.save(tmp_path / "g.npy", values)
    built = grid(tmp_path, np.ones((4, 5, 6)), g_file="g.npy")
    np.testing.assert_allclose(built.g_voxels, np.broadcast_to(values, (3, 4, 5, 6)), rtol=1e-6)
    assert built.groups() == ((0, 1, 2),)
    assert built.of_lasers([2]).g_voxels.shape == (1, 4, 5, 6)
    base = {"kind": "grid", "sigma_t_file": "sigma_t.npy", "g_file": "g.npy", "albedo": [0.9, 0.5, 0.1], **CORNERS}
    hollow = {"kind": "hollow", "radius_mm": 3.0}
    mixed = medium(folder=tmp_path, base=base, features=[hollow])
    kept = mixed.sigma_t[0] > 0
    np.testing.assert_allclose(mixed.g_voxels[:, kept], built.g_voxels[:, kept], rtol=1e-5)
    assert mixed.groups() == ((0, 1, 2),)


@pytest.mark.parametrize(
    ("values", "more", "message"),
    [
        (bad(1.0), {}, r"base\.g_file.*z=0 y=0 x=0 .*too large.*-0\.999 \.\. 0\.999"),
        (-bad(0.5), {}, r"too small.*>= -0\.999"),
        (np.zeros((4, 5, 7)), {}, r"the g grid is \(4, 5, 7\)"),
        (np.zeros((4, 5, 6)), {"g": 0.5}, r"either g or base\.g_file"),
    ],
)
def test_bad_grids_of_asymmetries(values: np.ndarray, more: dict[str, Any], message: str, tmp_path: Path) -> None:
    np.save(tmp_path / "sigma_t.npy", np.ones((4, 5, 6)))
    np.save(tmp_path / "g.npy", values)
    base = {"kind": "grid", "sigma_t_file": "sigma_t.npy", "albedo": 0.9, "g_file": "g.npy", **CORNERS}
    with pytest.raises(InputError, match=message) as caught:
        medium(folder=tmp_path, base=base, **more)
    assert "\n" not in str(caught.value)


def test_a_key_that_is_left_out_leaves_no_trace() -> None:
    """Results are known by the scene's dump: those of scenes from before `g` was a feature's stay valid."""
    config = MediumConfig.model_validate({"base": BASE, "features": [LAYERS]})
    assert "g" not in config.model_dump()["features"][0]
    config = MediumConfig.model_validate({"base": BASE, "features": [{**LAYERS, "g": 0.0}]})
    assert config.model_dump()["features"][0]["g"] == 0.0
    assert MediumConfig.model_validate(config.model_dump()) == config
