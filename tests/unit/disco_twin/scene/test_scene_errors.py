"""A scene with one thing wrong gives one line that names the file, the key, the value and what to do."""

from __future__ import annotations

from pathlib import Path

import pytest
from scene_texts import GOOD

from disco_twin.scene.scene import load_scene
from hw.base.config import Strict, check
from hw.base.errors import InputError
from pipeline.relight.lights import Environment, Uniform

LIGHT = '[[relight.lights]]\nkind = "uniform"\nname = "{}"\n[scan]'
# what is replaced, by what, and what the message must say
BAD = [
    ('kind = "sphere"', 'kind = "sphere"\nradios_mm = 3', ["object.shape.radios_mm", "unknown key", "'radius_mm'"]),
    ("[scan]", "[skan]", ["skan", "unknown key", "'scan'"]),
    ("[scan]", "[zzz]", ["zzz", "unknown key", "use one of", "object"]),
    ('kind = "sphere"', 'kind = "spere"', ["object.shape.kind = 'spere'", "pebble, sphere, box", "'sphere'"]),
    ('kind = "sphere"', "", ["object.shape.kind", "missing", "mesh, pebble"]),
    ('kind = "hollow"', 'kind = "holow"', ["object.medium.features[0].kind = 'holow'", "'hollow'"]),
    ("radius_mm = 3.0", "radius_mm = -3.0", ["object.medium.features[0].radius_mm = -3.0", "> 0"]),
    ("radius_mm = 3.0", "centre_mm = [1.0, 2.0, 3.0]", ["object.medium.features[0].radius_mm", "missing"]),
    ("albedo = [0.9, 0.8, 0.7]", "albedo = 1.5", ["object.medium.base.albedo = 1.5", ">= 0 and <= 1"]),
    ("albedo = [0.9, 0.8, 0.7]", "albedo = [0.9, 1.2, 0.7]", ["object.medium.base.albedo[1] = 1.2", "<= 1"]),
    ("albedo = [0.9, 0.8, 0.7]", "albedo = [0.9, 0.8]", ["object.medium.base.albedo has 2 values for 3 lasers"]),
    ("sigma_t_per_mm = 1.6", "sigma_t_per_mm = nan", ["object.medium.base.sigma_t_per_mm", "finite"]),
    ("sigma_t_per_mm = 1.6", 'sigma_t_per_mm = "thick"', ["object.medium.base.sigma_t_per_mm = 'thick'", "number"]),
    ('kind = "sphere"', 'kind = "mesh"\nfile = "no.ply"', ["object.shape.file = 'no.ply'", "no such file"]),
    ('name = "good"', "", ["name", "missing"]),
    ('name = "good"', 'name = "a/b"', ["name = 'a/b'", "pattern"]),
    ("format_version = 1", "format_version = 2", ["format_version = 2", "1"]),
    ("width = 192", "width = 3", ["rig.cameras[0].width = 3", ">= 16 and <= 8192"]),
    (
        'name = "c"\nposition_mm = [450.0, 0.0, 50.0]',
        'name = "c"\nposition_mm = [0.0, 0.0, 0.0]',
        ["relight.views[1]", "position_mm equals aim_mm", "aim at another point"],
    ),
    ('name = "c"', 'name = "a"', ["relight.views and rig.cameras", "distinct"]),
    ("vertices = 642", "vertices = 20", ["scan.vertices = 20", ">= 50"]),
    ("vertices = 642", "vertices = 50\n[simulation]\ntruth_columns = 40", ["simulation.truth_columns = 40", "half"]),
    ("vertices = 642", "vertices = 642\n[simulation]\nspot_noise = 0.01", ["simulation.spot_noise", "0.1"]),
    (
        "vertices = 642",
        "vertices = 642\n[simulation]\nwalks_per_spot = 9\nspot_noise = 5.0",
        ["walks_per_spot and spot_noise", "keep one of them"],
    ),
    ("[scan]", '[object.boundary]\nkind = "rough"\neta = 0.5\n[scan]', ["object.boundary.eta = 0.5", ">= 1 and <= 3"]),
    (
        "[scan]",
        '[object.boundary]\nkind = "shiny"\n[scan]',
        ["object.boundary.kind = 'shiny'", "rough, matched"],
    ),
    (
        "[scan]",
        '[object.boundary]\nkind = "smooth"\n[scan]',
        ["object.boundary.kind = 'smooth'", "camera", "'rough' with alpha = 0.02"],
    ),
    ("[scan]", "[object.boundary]\neta = 1.0\n[scan]", ["object.boundary", "eta = 1 bends no light", "'matched'"]),
    ("[scan]", LIGHT.format("studio/key"), ["relight.lights", "'studio/key'", "small letters"]),
    ("[scan]", LIGHT.format("../up"), ["relight.lights", "'../up'", "small letters"]),
    ("[scan]", LIGHT.format("Key"), ["relight.lights", "'Key'", "small letters"]),
    ("[scan]", LIGHT.format(""), ["relight.lights", "''", "1 to 32"]),
    ("[scan]", LIGHT.format("k" * 300), ["relight.lights", "kkkk...", "1 to 32"]),
    ("[scan]", '[relight]\nlights = ["moon"]\n[scan]', ["relight.lights", "unknown light 'moon'", "uniform"]),
    ("[scan]", '[[relight.lights]]\nkind = "uniform"\ncolour = [1.0]\n[scan]', ["relight.lights", "3 values"]),
    ("[scan]", "[relight.neck]\nthrough_mm = [0.0, 0.0]\n[scan]", ["relight.neck.through_mm"]),
    ("[scan]", "[relight.neck]\nnormal = [0.0, 0.0, 1.0]\n[scan]", ["relight.neck.through_mm", "missing"]),
    (
        "[scan]",
        "[relight.neck]\nthrough_mm = [0.0, 0.0, 1.0]\nnormal = [0.0, 0.0, 0.0]\n[scan]",
        ["relight.neck.normal", "zero"],
    ),
    ('kind = "hollow"\nradius_mm = 3.0', 'kind = "crack"\nsigma_t_per_mm = 1.0\nnormal = [0.0, 0.0, 0.0]', ["normal"]),
]


@pytest.mark.parametrize(("old", "new", "expected"), BAD, ids=lambda v: v if isinstance(v, str) else "")
def test_one_line(old: str, new: str, expected: list[str], tmp_path: Path) -> None:
    assert old in GOOD
    path = tmp_path / "scene.toml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 400
    for part in expected:
        assert part in message, message


def test_the_good_scene_is_good(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(GOOD)
    scene = load_scene(path)
    assert scene.name == "good"
    assert len(scene.relight.lights) == 7


@pytest.mark.parametrize(("lasers", "kept"), [((635.0,), (0,)), ((640.0, 473.0), (0, 2)), ((488.0,), (2,))])
def test_lights_without_a_stated_colour_fit_any_number_of_lasers(
    lasers: tuple[float, ...], kept: tuple[int, ...], tmp_path: Path
) -> None:
    """The shipped lights, and a light of one's own that states none, have the colour of the nearest wavelength."""
    path = tmp_path / "scene.toml"
    tables = "\n".join(f"[[rig.lasers]]\nwavelength_nm = {nm}" for nm in lasers)
    text = GOOD.replace("albedo = [0.9, 0.8, 0.7]", "albedo = 0.9")
    path.write_text(f"{text}\n{tables}\n")
    lights = {light.name: light for light in load_scene(path).relight.lights}
    assert len(lights) == 7
    uniform, environment = lights["uniform"], lights["environment"]
    assert isinstance(uniform, Uniform) and uniform.colour == (1.0,) * len(lasers)
    assert isinstance(environment, Environment)
    assert environment.constant == tuple((0.15, 0.2, 0.3)[k] for k in kept)
    assert environment.lobes[0].radiance == tuple((6.0, 5.0, 4.0)[k] for k in kept)
    path.write_text(f"{text}\n{tables}\n[[relight.lights]]\nkind = 'uniform'\nname = 'own'\n")
    (own,) = load_scene(path).relight.lights
    assert isinstance(own, Uniform) and own.colour == (1.0,) * len(lasers)


def test_files_that_are_no_scene(tmp_path: Path) -> None:
    (tmp_path / "quick.toml").write_text("name = \n")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"not valid TOML.*line 1"):
        load_scene(tmp_path / "quick.toml")
    with pytest.raises(InputError, match="UTF-8"):
        load_scene(tmp_path / "binary.toml")
    with pytest.raises(InputError, match=r"no such file.*did you mean .*quick\.toml"):
        load_scene(tmp_path / "quik.toml")
    with pytest.raises(InputError, match=r"is a folder, not a file.*Remedy: give the path of a scene's TOML file"):
        load_scene(tmp_path)


def test_file_names_are_relative_to_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hw.base.config import NearbyFile

    class OneFile(Strict):
        file: NearbyFile

    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "mesh.ply").write_text("")
    monkeypatch.chdir(tmp_path)
    assert check({"file": "mesh.ply"}, OneFile, "here/scene.toml").file == tmp_path / "here" / "mesh.ply"
