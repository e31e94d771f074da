"""Bodies inside the object: from the scene and from a mesh file's shells, and their refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scene_texts import GOOD

from disco_twin.object import shapes
from disco_twin.object.bodies import OBJECT, OwnMedium, Wall
from disco_twin.object.build import TwinObject, build_object
from disco_twin.scene.scene import load_scene
from hw.base.errors import InputError

DUCK = """
[[object.inside]]
shape = { kind = "sphere", radius_mm = 14.0 }
alpha = 0.1
[[object.inside.inside]]
shape = { kind = "box", size_mm = [6.0, 5.0, 4.0] }
centre_mm = [0.0, 0.0, 5.0]
eta = 1.5
medium = { sigma_t_per_mm = 2.0, albedo = [0.9, 0.8, 0.7], g = 0.3 }
[[object.inside.inside]]
shape = { kind = "torus", ring_radius_mm = 5.0, tube_radius_mm = 2.0 }
centre_mm = [0.0, 0.0, -5.0]
eta = 1.3
medium = "object"
"""


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spheres of few triangles: what is tested does not depend on how many there are."""
    monkeypatch.setattr(shapes, "SUBDIVISIONS", 3)


FEATURE = '[[object.medium.features]]\nkind = "hollow"\nradius_mm = 3.0\n'


def built(folder: Path, inside: str = DUCK, shape: str = 'kind = "sphere"') -> TwinObject:
    assert FEATURE in GOOD
    path = folder / "scene.toml"
    path.write_text(GOOD.replace('kind = "sphere"', shape).replace(FEATURE, "") + inside)
    return build_object(load_scene(path))


def test_bodies_of_a_scene(tmp_path: Path) -> None:
    cavity, box, torus = built(tmp_path).inside
    assert (cavity.around, box.around, torus.around) == (OBJECT, OBJECT + 1, OBJECT + 1)
    assert (cavity.medium, torus.medium) == (None, True)
    assert box.medium == OwnMedium((2.0,) * 3, (0.9, 0.8, 0.7), (0.3,) * 3)
    assert cavity.wall == Wall(1 / 1.3, 0.1)
    assert (box.wall.ratio, torus.wall.ratio) == (1.5, 1.3)
    np.testing.assert_allclose(box.mesh.bounds, [[-3, -2.5, 3], [3, 2.5, 7]])
    assert all(body.mesh.is_watertight and body.mesh.volume > 0 for body in (cavity, box, torus))


def test_a_wall_between_equal_indices_bends_nothing(tmp_path: Path) -> None:
    (body,) = built(tmp_path, '[[object.inside]]\nshape = { kind = "sphere", radius_mm = 9.0 }\neta = 1.3\n').inside
    assert body.wall == Wall(1.0, 0.0)


def test_lasers_share_a_walk_where_all_media_agree(tmp_path: Path) -> None:
    obj = built(tmp_path)
    assert obj.groups() == ((0, 1, 2),)
    obj = built(tmp_path, DUCK.replace("sigma_t_per_mm = 2.0", "sigma_t_per_mm = [2.0, 3.0, 2.0]"))
    assert obj.groups() == ((0, 2), (1,))
    box = obj.of_lasers([1]).inside[1].medium
    assert box == OwnMedium((3.0,), (0.8,), (0.3,))


def test_shells_of_a_mesh_file_are_bodies(tmp_path: Path) -> None:
    """A hollow body with a ball in it: the object is the outermost surface, which alone is scanned."""
    parts = [trimesh.creation.icosphere(subdivisions=2, radius=r) for r in (12.0, 9.0, 4.0)]
    parts[1].invert()
    trimesh.util.concatenate(parts).export(tmp_path / "hollow.ply")
    more = '[[object.inside]]\nshape = { kind = "sphere", radius_mm = 1.0 }\ncentre_mm = [0.0, 0.0, 10.5]\neta = 1.5\n'
    obj = built(tmp_path, more, 'kind = "mesh"\nfile = "hollow.ply"')
    assert np.linalg.norm(obj.mesh.vertices, axis=1).min() > 11
    cavity, ball, own = obj.inside
    assert (cavity.around, ball.around, own.around) == (OBJECT, OBJECT + 1, OBJECT)
    assert (cavity.medium, ball.medium) == (None, True)
    assert (cavity.wall, ball.wall) == (Wall(1 / 1.3, 0.3), Wall(1.3, 0.3))
    assert cavity.mesh.volume > ball.mesh.volume > 0


SPHERE = '[[object.inside]]\nshape = {{ kind = "sphere", radius_mm = {} }}\ncentre_mm = [0.0, 0.0, {}]\n{}\n'


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        (SPHERE.format(9.0, 15.0, ""), r"object\.inside\[0\]: crosses the wall around it near"),
        (SPHERE.format(9.0, 40.0, ""), r"object\.inside\[0\]: does not lie in what it is stated to be inside"),
        (SPHERE.format(19.995, 0.0, ""), r"comes as near as .* at least 0\.01 mm apart"),
        (SPHERE.format(5.0, 0.0, "") + SPHERE.format(2.0, 0.0, ""), r"inside\[1\]: lies beyond.*`inside` of the other"),
        (SPHERE.format(2.0, 0.0, "") + SPHERE.format(5.0, 0.0, ""), r"inside\[1\]: lies beyond"),
        (SPHERE.format(5.0, 0.0, "") + SPHERE.format(4.3, 3.7, ""), r"inside\[1\]: crosses the wall of another body"),
        (SPHERE.format(5.0, 0.0, "alpha = 0.01"), r"object\.inside\[0\]\.alpha.*0\.02 to 1; take 0"),
        (SPHERE.format(5.0, 0.0, "eta = 0.9"), r"object\.inside\[0\]\.eta = 0\.9.*>= 1"),
        (SPHERE.format(5.0, 0.0, 'medium = "glass"'), r"object\.inside\[0\]\.medium"),
        (SPHERE.format(5.0, 0.0, "medium = { sigma_t_per_mm = 1.0, albedo = [0.1, 0.2] }"), r"\.medium\.albedo has 2"),
        (SPHERE.format(5.0, 0.0, '[object.boundary]\nkind = "matched"'), "object.*without a boundary.*hollow"),
    ],
)  # fmt: skip
def test_refusals(inside: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as caught:
        built(tmp_path, inside)
    assert "\n" not in str(caught.value)
