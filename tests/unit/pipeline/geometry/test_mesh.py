"""Hat areas, rays, Laplacian and averaged kernels against exact answers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.geometry.pixel_footprints import trace_pixels, window
from pipeline.reconstruct.global_term.harmonics import harmonics
from pipeline.reconstruct.samples.distances import Pairs, hat_points, spot_pairs, vertex_pairs
from pipeline.reconstruct.samples.image_operators import bilinear_reading, footprint_reading, image_points, see_surface
from pipeline.reconstruct.samples.spots import Spots


@cache
def plane(n: int = 24, edge: float = 1.0) -> trimesh.Trimesh:
    """A flat patch of equilateral triangles. Not to be changed."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    points = np.column_stack([(i + 0.5 * (j % 2)).ravel() * edge, j.ravel() * edge * np.sqrt(3) / 2, np.zeros(n * n)])
    faces = []
    for a in range(n - 1):
        for b in range(n - 1):
            p, q, r, s = a * n + b, (a + 1) * n + b, a * n + b + 1, (a + 1) * n + b + 1
            faces += [[p, q, s], [p, s, r]] if b % 2 else [[p, q, r], [q, s, r]]
    return trimesh.Trimesh(points, faces, process=False)


@cache
def pairs_of_plane(n: int = 24) -> Pairs:
    """Of its vertices."""
    return vertex_pairs(plane(n))


def middle_of(mesh: trimesh.Trimesh) -> int:
    return int(np.argmin(np.linalg.norm(mesh.vertices - mesh.vertices.mean(axis=0), axis=1)))


def one_spot(mesh: trimesh.Trimesh, radius: float, tilt_deg: float = 0.0) -> Spots:
    at = mesh.vertices[[middle_of(mesh)]] + [[1e-3, 2e-3, 0]]
    hit = RayMesh.of(mesh).first_hit(np.add(at, [[0, 0, 5.0]]), np.array([[0, 0, -1.0]]))
    tilt = np.deg2rad(tilt_deg)
    direction = np.array([[np.sin(tilt), 0.0, -np.cos(tilt)]])
    return Spots(at, direction, np.array([[0, 0, 1.0]]), hit.triangle, hit.barycentric, np.ones(1), radius)


def test_rays_hit_where_they_should() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=5.0)
    hit = RayMesh.of(mesh).first_hit(np.array([[20.0, 0, 0], [20, 9, 0]]), np.array([[-1.0, 0, 0], [-1, 0, 0]]))
    assert hit.triangle[0] >= 0
    assert hit.triangle[1] == -1
    assert hit.distance[0] == pytest.approx(15.0, abs=0.05)
    assert hit.barycentric[0].sum() == pytest.approx(1.0)


def test_stiffness_integrates_the_gradient() -> None:
    """Rationale: for a linear function, u K u is |grad u|^2 times the area, exactly."""
    mesh = plane()
    u = np.asarray(mesh.vertices) @ [2.0, -1.0, 0.0]
    assert u @ (RayMesh.of(mesh).stiffness @ u) == pytest.approx(5.0 * mesh.area, rel=1e-12)


def bumpy() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=5.0)
    mesh.vertices *= 1.0 + 0.2 * np.sin(2.0 * mesh.vertices[:, :1])
    return mesh


def test_matrices_are_those_of_the_textbook() -> None:
    """Against sums over the faces' corners: half cotangents for the Laplacian, area / 12 (1 + delta) for the masses."""
    mesh = bumpy()
    laplacian, mass = np.zeros((2, len(mesh.vertices), len(mesh.vertices)))
    for face in mesh.faces:
        corners = mesh.vertices[face]
        area = 0.5 * np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
        mass[np.ix_(face, face)] += area / 12 * (1 + np.eye(3))
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            half = 0.5 * (corners[i] - corners[k]) @ (corners[j] - corners[k]) / (2 * area)
            laplacian[face[[i, j, i, j]], face[[j, i, i, j]]] += half * np.array([-1, -1, 1, 1])
    surface = RayMesh.of(mesh)
    np.testing.assert_allclose(surface.stiffness.toarray(), laplacian, atol=1e-10)
    np.testing.assert_allclose(surface.mass_matrix.toarray(), mass, atol=1e-12)
    np.testing.assert_allclose(surface.vertex_areas, mass.sum(axis=1), rtol=1e-12)


def test_first_hits_are_the_nearest_of_all_triangles() -> None:
    """Against every plane and every triangle in double precision; rays near an edge may take either side's triangle."""
    mesh, rng = bumpy(), np.random.default_rng(0)
    surface, origins = RayMesh.of(mesh), 20.0 * rng.standard_normal((300, 3))
    directions = 4.0 * rng.standard_normal((300, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    a, b, c = np.moveaxis(np.asarray(mesh.triangles), 1, 0)
    nearest = np.full(300, np.inf)
    for n, (o, d) in enumerate(zip(origins, directions, strict=True)):
        edges = np.stack([np.broadcast_to(-d, a.shape), b - a, c - a], axis=2)
        t, u, v = np.linalg.solve(edges, (o - a)[..., None])[..., 0].T
        inside = (t > 0) & (u >= 0) & (v >= 0) & (u + v <= 1)
        nearest[n] = t[inside].min(initial=np.inf)
    hit = surface.first_hit(origins, directions)
    assert 100 < np.isfinite(nearest).sum() < 300
    np.testing.assert_allclose(hit.distance, nearest, rtol=1e-5)
    some = np.flatnonzero(hit.triangle >= 0)
    at = surface.points(hit.triangle[some], hit.barycentric[some])
    np.testing.assert_allclose(at, origins[some] + nearest[some, None] * directions[some], atol=1e-4)
    hats = surface.interpolation(hit.triangle[some], hit.barycentric[some])
    np.testing.assert_allclose(hats @ mesh.vertices, at, atol=1e-12)


def test_a_mesh_is_prepared_once_until_it_changes() -> None:
    mesh = bumpy()
    before = RayMesh.of(mesh)
    assert RayMesh.of(mesh) is before
    mesh.vertices *= 2.0
    np.testing.assert_allclose(RayMesh.of(mesh).areas, 4.0 * before.areas)


def test_harmonics_of_the_sphere() -> None:
    """Rationale: eigenvalues on a sphere of radius r are l (l + 1) / r^2, 2 l + 1 times each."""
    found = harmonics(trimesh.creation.icosphere(subdivisions=3, radius=10.0), 9).eigenvalues * 100.0
    np.testing.assert_allclose(found, [0] + [2] * 3 + [6] * 5, atol=0.06)


def test_hat_weights_average_exactly() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    parts = hat_points(mesh, 3)
    per_vertex = np.bincount(parts.vertices.ravel(), parts.weights.ravel())
    np.testing.assert_allclose(per_vertex, 1.0, rtol=1e-12)


@pytest.mark.parametrize("length", [0.7, 1.5, 3.0])
def test_averaging_conserves_energy(length: float) -> None:
    """Rationale: the integral of a kernel over the plane is the same whatever it is averaged over."""
    mesh = plane(28)
    area = RayMesh.of(mesh).vertex_areas

    def kernel(d):  # type: ignore[no-untyped-def]
        return np.exp(-d / length) / (2 * np.pi * length**2)

    if length < 2:
        total = spot_pairs(mesh, one_spot(mesh, 0.4)).mean(kernel)[0] @ area
        assert total == pytest.approx(1.0, rel=0.02)
    total = pairs_of_plane(28).mean(kernel)[middle_of(mesh)] @ area
    assert total == pytest.approx(1.0, rel=0.02 if length < 2 else 0.15)  # a wide kernel leaves the patch


def test_mean_of_a_gaussian_is_the_wider_gaussian() -> None:
    """Rationale: second moments add: beam (r^2/4 per axis) and hat (edge^2 / 8 per axis)."""
    mesh = plane(28)
    spots = one_spot(mesh, 1.0)
    pairs = spot_pairs(mesh, spots)
    variance = 4.0
    wide = variance + 0.25 + 1 / 8
    got = pairs.mean(lambda d: np.exp(-(d**2) / (2 * variance)))[0]
    exact = variance / wide * np.exp(-(pairs.distance[0] ** 2) / (2 * wide))
    near = pairs.distance[0] < 3.9
    np.testing.assert_allclose(got[near], exact[near], rtol=0.005)


@pytest.mark.parametrize("length", [0.8, 2.0])
def test_far_pairs_continue_near_ones(length: float) -> None:
    """Rationale: an exponential averaged by histogram and by second moments, on either side of the limit."""
    mesh = plane()
    pairs = pairs_of_plane()
    row = pairs.distance[middle_of(mesh)]

    def kernel(d):  # type: ignore[no-untyped-def]
        return np.exp(-d / length)

    gain = pairs.mean(kernel)[middle_of(mesh)] / kernel(row)
    below, above = (row > 3.4) & (row < 3.99), (row > 4.01) & (row < 4.7)
    assert gain[below].mean() == pytest.approx(gain[above].mean(), rel=0.03)


def test_an_oblique_beam_is_longer() -> None:
    mesh = plane(28)
    straight, oblique = (spot_pairs(mesh, one_spot(mesh, 2.0, tilt)) for tilt in (0.0, 60.0))

    def square(d):  # type: ignore[no-untyped-def]
        return d**2 + 1e-6

    centre = middle_of(mesh)
    row = [np.flatnonzero(p.second == centre)[0] for p in (straight, oblique)]
    a, b = (float((p.histogram[[r]] @ square(p.centres))[0]) for p, r in zip((straight, oblique), row, strict=True))
    hat = 2 / 8
    assert (a - hat) == pytest.approx(2.0, rel=0.08)  # r^2 / 2
    assert (b - hat) == pytest.approx(5.0, rel=0.08)  # r^2 / 4 (1 + 1 / cos^2)


def wide_camera(position: tuple[float, float, float], focal_length_mm: float) -> PinholeCamera:
    return PinholeCamera.from_config(
        CameraConfig(
            name="it", position_mm=position, width=96, height=80, focal_length_mm=focal_length_mm, pixel_pitch_um=100.0
        )
    )


def test_area_that_a_wide_angle_sees_is_the_surface_s() -> None:
    """Rationale: pixels at the rim of a wide picture span less solid angle (cos^3); the areas of hats seen in full must
    still come out right, or their share of the vertex would not be 1.
    """
    plate = trimesh.creation.box((60.0, 1.0, 60.0)).subdivide_to_size(6.0)
    reading = footprint_reading(plate, wide_camera((0.0, -40.0, 0.0), 4.5), 1.3, 75.0)
    front = np.abs(plate.vertices[:, 1] + 0.5) < 1e-6
    inside = front & (np.abs(plate.vertices[:, [0, 2]]).max(axis=1) < 22)
    assert np.abs(plate.vertices[inside][:, 0]).max() > 15  # 20 degrees and more off the axis
    pixels = see_surface(plate, wide_camera((0.0, -40.0, 0.0), 4.5), 75.0)
    area = np.bincount(
        pixels.vertices.ravel(), (pixels.area[:, None] * pixels.barycentric).ravel(), len(plate.vertices)
    )
    np.testing.assert_allclose(area[inside], RayMesh.of(plate).vertex_areas[inside], rtol=0.05)
    assert (reading.share[inside] > 0.95).all()


def test_nothing_is_read_across_an_edge_of_depth() -> None:
    """Rationale: a small sphere before a large one; pixels on its outline mix both, and are read for neither."""
    near = trimesh.creation.icosphere(subdivisions=3, radius=5.0).apply_translation((0.0, -30.0, 0.0))
    scan = trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=3, radius=15.0), near])
    camera = wide_camera((0.0, -200.0, 0.0), 38.0)
    read = np.unique(see_surface(scan, camera, 80.0).pixel)
    direction = camera.rays(camera.pixel_centres())[1]
    off_axis = np.linalg.norm(np.cross(direction, [0.0, 1.0, 0.0]), axis=1)
    rim = np.abs(off_axis - 5.0 / 170.0) < 0.5 * 0.1 / 38.0  # within half a pixel of the small sphere's outline
    assert rim.sum() > 20
    assert not np.isin(np.flatnonzero(rim), read).any()
    assert np.isin(np.flatnonzero(off_axis < 0.5 * 5.0 / 170.0), read).all()


def test_points_of_the_surface_are_found_in_the_image_where_nothing_hides_them() -> None:
    """Rationale: a small sphere before a large one hides a disc of it, whose rim is known; texels are any points.

    Expected behaviour: pixels are the projections; visible are the near sides but for that disc, and nothing else.
    """
    near = trimesh.creation.icosphere(subdivisions=4, radius=5.0).apply_translation((0.0, -30.0, 0.0))
    scan = trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=4, radius=15.0), near])
    camera = wide_camera((0.0, -200.0, 0.0), 38.0)
    points, face = trimesh.sample.sample_surface(scan, 4000, seed=1)
    normals = scan.face_normals[face]
    found = image_points(scan, camera, points, normals, np.full(len(points), 1e-3))
    np.testing.assert_allclose(found.pixel, camera.project(points)[0])
    towards = camera.position - points
    facing = (normals * towards).sum(axis=1) > 0
    way = -towards / np.linalg.norm(towards, axis=1)[:, None]
    to_near = np.array([0.0, -30.0, 0.0]) - camera.position
    beside = np.linalg.norm(to_near - (way @ to_near)[:, None] * way, axis=1)  # of the small sphere's centre
    large = np.linalg.norm(points, axis=1) < 16.0
    expected = facing & ~(large & (beside < 5.0))
    clear = (np.abs(beside - 5.0) > 0.1) | ~large  # its facets lie within its radius
    assert (found.visible == expected)[clear].all()
    assert (facing & ~found.visible & large).sum() > 50
    assert found.cosine[found.visible].min() > 0
    aside = image_points(
        scan, replace(camera, centre=camera.centre + 48.0), points, normals, np.full(len(points), 1e-3)
    )
    assert 0 < aside.visible.sum() < found.visible.sum()  # the others lie outside the picture
    hidden = np.flatnonzero(facing & ~found.visible & large & clear)
    reading = bilinear_reading(scan, camera, 1.3, 80.0)
    vertex = np.argmin(np.linalg.norm(scan.vertices - points[hidden[0]], axis=1))
    assert reading.share[vertex] == 0.0


@pytest.mark.parametrize("limit", [40.0, 60.0, 75.0])
def test_surface_seen_at_a_grazing_angle_is_not_read(limit: float) -> None:
    """Rationale: on a sphere the angle of view is known everywhere. Expected: read up to the limit, and nothing beyond
    (but for the third of a degree by which facets and interpolated normals differ from the sphere).
    """
    ball = trimesh.creation.icosphere(subdivisions=4, radius=15.0)
    camera = wide_camera((0.0, -200.0, 0.0), 38.0)
    for reading in (footprint_reading, bilinear_reading):
        share = reading(ball, camera, 1.3, limit).share
        towards = camera.position - ball.vertices
        angle = np.rad2deg(np.arccos((ball.vertices * towards).sum(axis=1) / np.linalg.norm(towards, axis=1) / 15.0))
        hat = np.rad2deg(ball.edges_unique_length.max() / 15.0)
        assert share[angle > limit + hat + 0.4].max() == 0.0
        assert (share[angle < limit - hat - 4.0] > 0.5).all()
    cosine = see_surface(ball, camera, limit).cosine
    assert np.cos(np.deg2rad(limit)) < cosine.min() < np.cos(np.deg2rad(limit - 4.0))


@pytest.mark.parametrize("aside_px", [0.0, 25.0])
def test_every_ray_that_meets_the_surface_is_seen_once(aside_px: float) -> None:
    """Rationale: rays are cast in bands and only where the mesh can be, numbered by hand. Against all rays at once.

    Expected behaviour: the same pixels, triangles and places, also where the picture cuts the object off.
    """
    scan = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    camera = wide_camera((0.0, -200.0, 0.0), 38.0)
    camera = replace(camera, centre=camera.centre + aside_px)
    origins, directions = camera.rays(camera.pixel_centres(3))
    hit = RayMesh.of(scan).first_hit(origins, directions)
    rows, columns = np.divmod(np.flatnonzero(hit.triangle >= 0), 3 * camera.width)
    order = np.flatnonzero(hit.triangle >= 0)
    bands = list(trace_pixels(scan, camera, 3))
    assert len(bands) > 1
    np.testing.assert_array_equal(np.concatenate([b.pixel for b in bands]), rows // 3 * camera.width + columns // 3)
    np.testing.assert_array_equal(np.concatenate([b.triangle for b in bands]), hit.triangle[order])
    np.testing.assert_allclose(np.concatenate([b.distance for b in bands]), hit.distance[order])
    normals = RayMesh.of(scan).smooth_normals(hit.triangle[order], hit.barycentric[order])
    cosine = -(normals * directions[order]).sum(axis=1)
    np.testing.assert_allclose(np.concatenate([b.cosine for b in bands]), cosine, atol=1e-12)


def test_the_window_is_all_of_the_image_where_that_is_not_certain() -> None:
    """Expected behaviour: two pixels around the outline; all of it for a mesh that reaches behind the camera; not empty
    for one beside the picture.
    """
    ball = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    camera = wide_camera((0.0, -200.0, 0.0), 38.0)
    corner = camera.project(ball.vertices)[0]
    rows, columns = window(ball, camera)
    assert 2 <= corner[:, 0].min() - columns.start < 3
    assert 2 <= rows.stop - corner[:, 1].max() < 3
    every = slice(0, camera.height), slice(0, camera.width)
    assert window(ball.copy().apply_scale(20.0), camera) == every
    rows, columns = window(ball, replace(camera, centre=camera.centre + 1e4))
    assert rows.stop > rows.start
    assert columns.stop > columns.start
