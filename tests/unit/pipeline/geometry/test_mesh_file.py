"""Mesh files as programs write them: every form of one solid is the same solid; what cannot be one is refused."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_writers import L, Solid, obj, ply_ascii, ply_binary, prism, stl_ascii, stl_binary

from hw.base.arrays import F64
from hw.base.errors import InputError
from pipeline.geometry.mesh_file import load_mesh, read_scan, triangulate
from pipeline.geometry.mesh_formats import Polygons

FORMS: dict[str, tuple[str, Callable[[Solid], bytes]]] = {
    "ascii": (".ply", ply_ascii),
    "little": (".ply", ply_binary),
    "big": (".ply", lambda s: ply_binary(s, ">", "ushort", "uint")),
    "short": (".ply", lambda s: ply_binary(s, "<", "int", "short", b"\r\n")),
    "carriage": (".ply", lambda s: ply_binary(s, ">", "char", "ushort", b"\r")),
    "wide": (".PLY", lambda s: ply_ascii(s, "uint", "uint").replace(b"\n", b"\r\n")),
    "obj": (".obj", obj),
    "bom": (".obj", lambda s: b"\xef\xbb\xbf" + obj(s, newline="\r\n")),
    "unicode": (".obj", lambda s: obj(s).decode("latin-1").encode("utf-16")),
    "texture": (".obj", lambda s: obj(s, lambda v, _: f"{v + 1}/1/1")),
    "normals": (".obj", lambda s: obj(s, lambda v, _: f"{v + 1}//1")),
    "relative": (".obj", lambda s: obj(s, lambda v, n: str(v - n))),
    "continued": (".OBJ", lambda s: obj(s).replace(b"  ", b" \\\n ")),
}


def loaded(folder: Path, name: str, content: bytes) -> trimesh.Trimesh:
    (folder / name).write_bytes(content)
    return load_mesh(folder / name)


def polygons(solid: Solid) -> Polygons:
    corners = np.concatenate([np.array(p) for p in solid[1]])
    return Polygons(solid[0], corners, np.array([len(p) for p in solid[1]]))


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_an_l_is_the_same_l(form: str, tmp_path: Path) -> None:
    """Its ends are concave hexagons; PLY and OBJ also carry what is to be read over."""
    suffix, write = FORMS[form]
    mesh = loaded(tmp_path, f"L{suffix}", write(prism(L)))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.area == pytest.approx(3400, abs=1e-9)
    assert mesh.volume == pytest.approx(10000, abs=1e-8)
    other = loaded(tmp_path, "L.obj", obj(prism(L)))
    np.testing.assert_array_equal(mesh.vertices, other.vertices)
    np.testing.assert_array_equal(mesh.faces, other.faces)


@pytest.mark.parametrize("write", [stl_ascii, stl_binary, lambda t: stl_binary(t) + b"behind"])
def test_stl_joins_corners_in_the_same_place_and_no_others(write: Callable[[F64], bytes], tmp_path: Path) -> None:
    solid = prism(L)
    corners = solid[0][triangulate(polygons(solid))]
    mesh = loaded(tmp_path, "L.stl", write(corners))
    assert mesh.is_watertight and len(mesh.vertices) == 12 and mesh.volume == pytest.approx(10000, rel=1e-6)
    corners[0, 0, 0] = np.nextafter(np.float32(corners[0, 0, 0]), np.float32(99))
    assert not loaded(tmp_path, "L.stl", write(corners)).is_watertight


def test_several_solids_objects_and_repeated_vertices(tmp_path: Path) -> None:
    one = trimesh.creation.icosphere(subdivisions=2, radius=20)
    far = np.asarray(one.triangles) + np.array([60.0, 0, 0])
    both = loaded(tmp_path, "a.stl", stl_ascii(np.asarray(one.triangles)) + b"\n" + stl_ascii(far))
    assert both.is_watertight and both.volume == pytest.approx(2 * one.volume, rel=1e-6)
    # Two objects one after the other, with relative numbers: they are counted from where they stand.
    solid: Solid = np.asarray(one.vertices), one.faces.tolist()
    shifted: Solid = solid[0] + np.array([60.0, 0, 0]), solid[1]
    text = b"".join(obj(s, lambda v, n: str(v - n)) for s in (solid, shifted))
    mesh = loaded(tmp_path, "a.obj", text)
    assert mesh.is_watertight and mesh.volume == pytest.approx(2 * one.volume, rel=1e-6)
    # A seam: vertices repeated along a texture's border; a mesh that is closed as it is keeps vertices that coincide.
    split: Solid = np.asarray(one.triangles).reshape(-1, 3), np.arange(3 * len(one.faces)).reshape(-1, 3).tolist()
    assert len(loaded(tmp_path, "a.ply", ply_binary(split)).vertices) == len(one.vertices)
    twin: Solid = np.concatenate([solid[0], solid[0]]), [*solid[1], *(np.array(solid[1]) + len(solid[0])).tolist()]
    assert len(loaded(tmp_path, "a.ply", ply_binary(twin)).vertices) == 2 * len(one.vertices)


def test_order_is_kept_and_unused_vertices_go(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=20)
    ball.export(tmp_path / "ball.ply")
    again = read_scan(tmp_path / "ball.ply")
    np.testing.assert_array_equal(again.vertices, np.asarray(ball.vertices, np.float32))
    np.testing.assert_array_equal(again.faces, ball.faces)
    unused: Solid = (
        np.insert(np.asarray(ball.vertices), 5, [np.nan, 0, 0], axis=0),
        (ball.faces + (ball.faces >= 5)).tolist(),
    )
    np.testing.assert_array_equal(loaded(tmp_path, "unused.ply", ply_binary(unused)).faces, ball.faces)


def test_triangles_without_area_go_and_the_mesh_stays_closed(tmp_path: Path) -> None:
    """A corner on an edge, with a triangle of no height between; corners that repeat; a polygon of no area."""
    box = prism(np.array([[0, 0], [30, 0], [30, 30], [0, 30]], float), 30.0)
    vertices = np.concatenate([box[0], [[15, 0, 0]]])
    for sliver in ([0, 1, 8], [0, 1, 1, 8]):
        front = [[8, 1, 5], [0, 8, 5], [0, 5, 4]]
        faces = [f for f in box[1] if list(f) != [0, 1, 5, 4]]
        mesh = loaded(tmp_path, "a.obj", obj((vertices, [*faces, *front, sliver, [2, 2, 3]])))
        assert mesh.is_watertight and len(mesh.vertices) == 9
        assert mesh.area == pytest.approx(5400) and mesh.volume == pytest.approx(27000)


def keyhole() -> Solid:
    """A square tube: its ends are polygons that reach their hole by a bridge that they pass twice."""
    outer, inner = (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float) * r for r in (20, 10))
    low = np.column_stack([np.concatenate([outer, inner]), np.full(8, -10.0)])
    end = [0, 1, 2, 3, 0, 4, 7, 6, 5, 4]
    sides = [(i, (i + 1) % 4, 8 + (i + 1) % 4, 8 + i) for i in range(4)]
    holes = [(4 + (i + 1) % 4, 4 + i, 12 + i, 12 + (i + 1) % 4) for i in range(4)]
    return np.concatenate([low, low + np.array([0, 0, 20.0])]), [end[::-1], [8 + v for v in end], *sides, *holes]


def test_polygons_with_a_bridge_to_a_hole(tmp_path: Path) -> None:
    mesh = loaded(tmp_path, "tube.ply", ply_ascii(keyhole()))
    assert mesh.is_watertight and mesh.euler_number == 0
    assert mesh.volume == pytest.approx(20 * (40**2 - 20**2))


def test_quadrilaterals_are_cut_inside() -> None:
    """A dart has one diagonal inside it, wherever its corners begin; so has a triangle with a corner on a side."""
    for quad in ([[0, 0], [4, -2], [1, 0], [4, 2]], [[0, 0], [2, 0], [4, 0], [2, 3]]):
        points = np.column_stack([quad, np.zeros(4)])
        area = 0.5 * np.cross(points[2] - points[0], points[3] - points[1])[2]
        for first in range(4):
            faces = triangulate(Polygons(np.roll(points, first, axis=0), np.arange(4), np.array([4])))
            a, b, c = np.moveaxis(np.roll(points, first, axis=0)[faces], 1, 0)
            found = 0.5 * np.cross(b - a, c - a)[:, 2] * np.sign(area)
            assert (found > 0).all() and found.sum() == pytest.approx(abs(area))


@st.composite
def outlines(draw: st.DrawFn) -> F64:
    """Star-shaped, concave as a rule, some with corners on straight edges."""
    n = draw(st.integers(3, 14))
    radii = draw(st.lists(st.floats(2.0, 40.0), min_size=n, max_size=n))
    angle = 2 * np.pi * np.arange(n) / n
    points = np.column_stack([np.cos(angle), np.sin(angle)]) * np.array(radii)[:, None]
    middle = draw(st.lists(st.booleans(), min_size=n, max_size=n))
    out: list[F64] = []
    for k in range(n):
        out.append(points[k])
        if middle[k]:
            out.append(0.5 * (points[k] + points[(k + 1) % n]))
    return np.array(out)


@settings(max_examples=60, deadline=None)
@given(outlines(), st.integers(0, 2**32 - 1))
def test_triangles_keep_a_polygons_area_and_normal(outline: F64, seed: int) -> None:
    """Any plane, any concave outline: the triangles add up to Newell's area vector, none folds back, and each edge
    of the polygon belongs to one of them."""
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))[:3, :3]
    points = np.column_stack([outline, np.full(len(outline), 5.0)]) @ turn.T
    n = len(points)
    faces = triangulate(Polygons(points, np.arange(n), np.array([n])))
    vector = 0.5 * np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    areas = 0.5 * np.cross(b - a, c - a) @ (vector / np.linalg.norm(vector))
    assert len(faces) == n - 2
    assert areas.min() > -1e-9 and areas.sum() == pytest.approx(np.linalg.norm(vector), rel=1e-9)
    directed = {(int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3)}
    assert {(k, (k + 1) % n) for k in range(n)} <= directed


@settings(max_examples=25, deadline=None)
@given(outlines(), st.integers(0, 2**32 - 1))
def test_forms_agree_on_any_prism(tmp_path_factory: pytest.TempPathFactory, outline: F64, seed: int) -> None:
    folder = tmp_path_factory.getbasetemp()
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))[:3, :3]
    solid = prism(outline, 15.0, turn)
    first = loaded(folder, "one.ply", ply_ascii(solid))
    x, y = outline.T
    area = 0.5 * abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    assert first.is_watertight and first.volume == pytest.approx(15 * area, rel=1e-5)
    for name in ("little", "big", "relative"):
        mesh = loaded(folder, f"other{FORMS[name][0]}", FORMS[name][1](solid))
        np.testing.assert_array_equal(mesh.faces, first.faces)
        np.testing.assert_allclose(mesh.vertices, first.vertices, rtol=0, atol=1e-6)


BOX = prism(np.array([[0, 0], [30, 0], [30, 30], [0, 30]], float), 30.0)
HEAD = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n9 0 0\n0 9 0\n"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.ply", b"", "empty"),
        ("a.obj", b"\xef\xbb\xbf", "empty"),
        ("a.ply", b"not a mesh", "is no PLY file"),
        ("a.ply", b"ply\nformat ascii 1.0\n", "header does not end"),
        ("a.ply", b"ply\nelement vertex 3\nend_header\n", "no known format"),
        ("a.ply", b"ply\nformat ascii 2.0\nend_header\n", "no known format"),
        ("a.ply", HEAD.replace(b"float z", b"real z") + FACE, "header cannot be read at 'property real z'"),
        ("a.ply", HEAD.replace(b"float z", b"float w") + FACE + b"3 0 1 2\n", "no vertices with x, y and z"),
        ("a.ply", HEAD + b"end_header\n0 0 0\n9 0 0\n0 9 0\n", "only points, no faces"),
        ("a.ply", HEAD + FACE + b"3 0 1\n", "ends before its 1 elements 'face'"),
        ("a.ply", HEAD + FACE + b"3 0 1 x\n", "'face' are not all numbers"),
        ("a.ply", HEAD + FACE + b"3 0 1 1.5\n", "by a fraction"),
        (
            "a.ply",
            HEAD.replace(b"float x", b"list uchar float x") + b"end_header\n" + 3 * b"1 0 0 0\n",
            "no vertices with x, y",
        ),
        ("a.ply", HEAD + FACE.replace(b"list uchar", b"list float") + b"3 0 1 2\n", "cannot be read at 'property list"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 99999999999999999999 1 2\n", "line 4: a triangle names a vertex"),
        ("a.ply", HEAD + FACE + b"3 0 1 3\n", "does not exist"),
        ("a.ply", HEAD + FACE + b"3 0 1 -1\n", "does not exist"),
        ("a.ply", HEAD + FACE.replace(b"9 0 0", b"nan 0 0") + b"3 0 1 2\n", "not a finite number"),
        ("a.ply", HEAD + FACE.replace(b"9 0 0", b"1e300 0 0") + b"3 0 1 2\n", "not a finite number"),
        ("a.ply", HEAD + FACE + b"3 0 1 1\n", "degenerate"),
        (
            "a.ply",
            HEAD.replace(b"vertex 3", b"vertex 4000000000") + FACE + b"3 0 1 2\n",
            "4000000000 elements 'vertex'",
        ),
        ("a.ply", ply_binary(BOX)[:-20], "ends before its 6 elements 'face'"),
        ("a.ply", ply_binary(BOX)[:500], "ends before its 8 elements 'vertex'"),
        ("a.obj", b"v 0 0 0\nv 9 0\n", "line 2 cannot be read: 'v 9 0'"),
        ("a.obj", b"v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 0\n", "line 4.*does not exist"),
        ("a.obj", b"v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 -4\n", "line 4.*does not exist"),
        ("a.obj", b"v 0 0 0\nf 1 1 x/1\n", "line 2 cannot be read"),
        ("a.obj", b"v 0 0 0\nv 9 0 0\nv 0 9 0\n", "empty"),
        (
            "a.obj",
            b"v 0 0 0\nv 8 8 0\nv 0 8 0\nv 8 0 0\nv 4 -1 0\nf 1 2 3 4 5\n",
            "polygon 0 of 5 corners crosses itself",
        ),
        ("a.stl", b"solid a\nfacet\n", "is no STL|ends after 0 triangles"),
        ("a.stl", stl_ascii(np.ones((4, 3, 3)))[:-150], "ends after .* triangles, without 'endsolid'"),
        ("a.stl", stl_binary(np.ones((4, 3, 3)))[:-20], "ends after 3 of 4 triangles"),
        ("a.stl", bytes(84), "empty"),
        ("a.obj", ply_binary(BOX), r"is a \.ply file by its content. Remedy: name it \.ply"),
        ("a.ply", stl_ascii(np.ones((4, 3, 3))), r"is a \.stl file by its content. Remedy: name it \.stl"),
        ("a.stl", b"\x89PNG\r\n\x1a\n", r"is a \.png file by its content. Remedy: export the mesh"),
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\n", "pointer of Git LFS.*git lfs pull"),
        ("a.gltf", b"{}", r"unknown type of mesh file \(allowed: \.ply, \.obj, \.stl\)"),
    ],
)
def test_what_is_no_mesh_is_refused_in_one_line(name: str, content: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        load_mesh(path, "key")
    said = str(caught.value)
    assert "\n" not in said and said.startswith(f"{path}: key: ") and ("Remedy: " in said or "allowed: " in said)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([*FORMS]), st.lists(st.tuples(st.integers(0, 10_000), st.binary(max_size=4)), max_size=4))
def test_damage_is_refused_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, form: str, changes: list[tuple[int, bytes]]
) -> None:
    """Bytes taken out, overwritten, put in: a mesh, or a refusal; no other error, and no warning."""
    suffix, write = FORMS[form]
    content = write(prism(L))
    for at, new in changes:
        content = content[: at % len(content)] + new + content[at % len(content) + 2 :]
    with suppress(InputError):
        loaded(tmp_path_factory.getbasetemp(), f"damaged{suffix}", content)


def test_numbers_that_are_none_are_named_without_a_warning(tmp_path: Path) -> None:
    """A signalling NaN, which NumPy warns of when it is converted."""
    content = bytearray(stl_binary(np.random.default_rng(0).random((4, 3, 3))))
    content[84 + 12 : 84 + 16] = b"\x01\x00\x80\x7f"
    with pytest.raises(InputError, match="not a finite number"):
        loaded(tmp_path, "a.stl", bytes(content))


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    (tmp_path / "folder.ply").mkdir()
    for name, why in (("folder.ply", "Is a directory"), ("gone.obj", "No such file")):
        with pytest.raises(InputError, match=rf"cannot be read \({why}.*Remedy: correct the path"):
            load_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda m: m.apply_scale(1e-3), "0.04 mm large.*scale it by 1000 if it is in metres"),
        (lambda m: m.apply_scale(1e3), "scale it by 0.001 if it is in micrometres"),
        (lambda m: m.invert(), "inside out.*`disco-twin mesh"),
        (lambda m: m.update_faces(np.arange(len(m.faces)) > 2), "9 of 480 edges.*`disco-twin mesh .*-closed.ply`"),
    ],
)
def test_scans_that_no_rig_can_mean(change: Callable[[trimesh.Trimesh], None], says: str, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=20)
    change(ball)
    ball.export(tmp_path / "scan.ply")
    with pytest.raises(InputError, match=says) as caught:
        read_scan(tmp_path / "scan.ply")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="Remedy: capture again"):
        read_scan(tmp_path / "scan.ply", "capture again")
