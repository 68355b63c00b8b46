"""Shapes: closed where solids are, with the volumes and areas of the closed forms, mapped, and refused."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from mesh_measures import area, area_vectors, corners, polygon_share, volume

from qsim.scene.props import gear, letters, rotor, spring
from qsim.scene.rotation import pose_matrix, rotation_matrix
from qsim.scene.shapes import (
    ball,
    blob,
    box,
    cylinder,
    extruded,
    filled,
    merged,
    mesh_file,
    moved,
    polyhedron,
    revolved,
    sheet,
    torus,
    wire,
)

CIRCLE = np.stack([np.cos(a := np.linspace(0, 2 * np.pi, 97)[:-1]), np.sin(a), 0 * a], 1)
SQUARE = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
KNOT = np.stack([(2 + np.cos(3 * a)) * np.cos(2 * a), np.sin(3 * a), (2 + np.cos(3 * a)) * np.sin(2 * a)], 1)


def rng() -> np.random.Generator:
    return np.random.default_rng(4)


SOLIDS = {  # without T-junctions: every edge belongs to two triangles
    "box": box(0.3, 0.2, 0.1),
    "ball": ball(0.5),
    "torus": torus(0.5, 0.2),
    "cylinder": cylinder(0.2, 0.7),
    "cone": cylinder(0.2, 0.7, taper=0.0),
    "frustum": cylinder(0.2, 0.7, taper=0.5),
    "polyhedron": polyhedron(rng(), 0.4),
    "blob": blob(rng(), 0.4),
    "ring of wire": wire(CIRCLE, 0.05, closed=True),
    "knot of wire": wire(KNOT, 0.05, closed=True),
}
PLATES = {  # their fronts are cut at more places than their walls: closed, but with T-junctions
    "frame": extruded([SQUARE, 0.5 * SQUARE], 0.2),
    "gear": gear(12, 0.1, 0.02),
    "spoked gear": gear(17, 0.1, 0.02, spokes=5),
    "letters": letters("Q8%g", 0.05, 0.01),
}
SHEETS = {"sheet": sheet(2, 1, 3, 5), "rotor": rotor(5, 0.3), "spring": spring(0.1, 0.3, 7.5, 0.004)}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_watertight_with_outward_faces(name):
    mesh = SOLIDS[name]
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    solid.merge_vertices(merge_tex=True, merge_norm=True)
    solid.update_faces(solid.nondegenerate_faces())
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0


@pytest.mark.parametrize("name", PLATES)
def test_plates_have_no_net_area_and_outward_faces(name):
    mesh = PLATES[name]
    np.testing.assert_allclose(area_vectors(mesh).sum(0), 0, atol=1e-12)  # the law of every closed surface
    assert volume(mesh) > 0
    away = moved(mesh, pose_matrix(rotation_matrix((3, 2, 1), 0.4), (3, -2, 5)))
    assert volume(away) == pytest.approx(volume(mesh), rel=1e-8)


@pytest.mark.parametrize("name", SOLIDS | PLATES | SHEETS)
def test_every_mesh_is_finite_mapped_and_used(name):
    mesh = (SOLIDS | PLATES | SHEETS)[name]
    assert np.isfinite(mesh.vertices).all()
    assert mesh.uv is not None
    assert np.isfinite(mesh.uv).all()
    assert set(mesh.faces.ravel()) == set(range(len(mesh.vertices)))
    assert np.ptp(mesh.uv, axis=0).min() > 0


def test_volumes_and_areas_of_flat_solids_are_exact():
    assert volume(box(0.3, 0.2, 0.1)) == pytest.approx(0.006)
    assert area(box(0.3, 0.2, 0.1)) == pytest.approx(2 * (0.06 + 0.03 + 0.02))
    assert area(sheet(2, 3, 4, 5)) == pytest.approx(6)
    frame = extruded([SQUARE, 0.5 * SQUARE], 0.2)
    assert volume(frame) == pytest.approx((4 - 1) * 0.2)
    assert area(frame) == pytest.approx(2 * 3 + 0.2 * (8 + 4))


def test_round_solids_have_the_volume_of_their_polygons():
    share = polygon_share(48)
    assert volume(cylinder(0.2, 0.7)) == pytest.approx(np.pi * 0.04 * 0.7 * share)
    assert volume(cylinder(0.2, 0.7, taper=0.0)) == pytest.approx(np.pi * 0.04 * 0.7 / 3 * share)
    assert volume(cylinder(0.2, 0.7, taper=0.5)) == pytest.approx(np.pi * 0.7 / 3 * (0.04 + 0.02 + 0.01) * share)
    side = revolved([(0.2, 0.0), (0.2, 0.5)], 48)
    assert area(side) == pytest.approx(48 * 2 * 0.2 * np.sin(np.pi / 48) * 0.5)


@pytest.mark.parametrize(
    ("make", "volume_of_limit", "area_of_limit"),
    [
        (lambda n: ball(0.5, n), 4 / 3 * np.pi * 0.125, np.pi),
        (lambda n: torus(0.5, 0.2, n), 2 * np.pi**2 * 0.5 * 0.04, 4 * np.pi**2 * 0.1),
    ],
)
def test_finer_meshes_converge_quadratically_to_the_smooth_solid(make, volume_of_limit, area_of_limit):
    errors = np.array([[volume_of_limit - volume(m), area_of_limit - area(m)] for m in map(make, (32, 64, 128))])
    assert (errors > 0).all()  # inscribed
    np.testing.assert_allclose(errors[:-1] / errors[1:], 4, rtol=0.05)


def test_sizes_are_the_requested_ones():
    for mesh, size in (
        (box(0.3, 0.2, 0.1), (0.3, 0.2, 0.1)),
        (ball(0.5), (1, 1, 1)),
        (torus(0.5, 0.2), (1.4, 0.4, 1.4)),
        (cylinder(0.2, 0.7), (0.4, 0.7, 0.4)),
        (sheet(2, 3), (2, 3, 0)),
        (wire(CIRCLE, 0.25, 16, closed=True), (2.5, 2.5, 0.5)),
    ):
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), size, atol=1e-12)
        np.testing.assert_allclose(mesh.vertices.max(0) + mesh.vertices.min(0), 0, atol=1e-12)


def test_moved_keeps_faces_outward_even_in_a_mirror():
    solid = box(1, 2, 3)
    mirror = np.diag([-1.0, 2, 1, 1])
    assert volume(moved(solid, mirror)) == pytest.approx(2 * volume(solid))


def test_merged_adds_up():
    both = merged([box(1, 1, 1), moved(ball(0.2), pose_matrix(None, (5, 0, 0)))])
    assert volume(both) == pytest.approx(1 + volume(ball(0.2)))
    assert not both.smooth
    assert merged([ball(1), ball(2)]).smooth


def test_filled_follows_the_even_odd_rule_with_holes_and_islands():
    loops = [SQUARE, 0.5 * SQUARE[::-1], 0.25 * SQUARE]  # hole drawn backwards: direction does not matter
    points, triangles = filled(loops)
    corner = points[triangles]
    a = corner[:, 1] - corner[:, 0]
    b = corner[:, 2] - corner[:, 0]
    signed = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    assert (signed >= -1e-15).all()  # counter-clockwise
    assert signed.sum() == pytest.approx(4 - 1 + 0.25)
    with pytest.raises(ValueError, match="the outline has no area"):
        filled([np.array([[0.0, 0], [1, 0], [2, 0]])])


@pytest.mark.parametrize("path", [CIRCLE, KNOT], ids=["circle", "knot"])
def test_a_closed_wire_is_as_thick_at_its_seam_as_elsewhere(path):
    radius = 0.05
    sides = 8
    rings = wire(path, radius, sides, closed=True).vertices.reshape(len(path) + 1, sides + 1, 3)
    middles = np.vstack([path, path[:1]])
    np.testing.assert_allclose(np.linalg.norm(rings - middles[:, None], axis=2), radius, rtol=1e-9)
    # Halfway between two rings the tube is pinched if one is turned against the other
    halfway = (rings[1:] + rings[:-1]) / 2 - ((middles[1:] + middles[:-1]) / 2)[:, None]
    assert np.linalg.norm(halfway, axis=2).min() > 0.97 * radius
    np.testing.assert_allclose(rings[-1], rings[0], atol=1e-12)


def test_wire_has_the_volume_of_its_length():
    share = polygon_share(16)
    tube = wire([(0, 0, z) for z in np.linspace(0, 2, 5)], 0.1, 16)
    assert area(tube) == pytest.approx(2 * 16 * 2 * 0.1 * np.sin(np.pi / 16))
    ring = wire(CIRCLE, 0.1, 16, closed=True)
    assert volume(ring) == pytest.approx(2 * np.pi**2 * 0.01 * share, rel=2e-3)  # Pappus
    coil = spring(0.1, 0.3, 5.0, 0.004)
    length = np.hypot(2 * np.pi * 5 * 0.1, 0.3)
    assert area(coil) == pytest.approx(2 * 8 * np.sin(np.pi / 8) * 0.004 * length, rel=0.01)


def test_stones_are_convex_and_differ_by_seed():
    stone = polyhedron(rng(), 0.4)
    normal = area_vectors(stone)
    heights = np.einsum("fi,fvi->fv", normal, stone.vertices[None] - corners(stone)[:, :1])
    assert heights.max() < 1e-12  # no vertex in front of any face
    other = polyhedron(np.random.default_rng(5), 0.4)
    assert other.vertices.shape != stone.vertices.shape or not np.allclose(other.vertices, stone.vertices)
    assert not np.allclose(blob(np.random.default_rng(5), 0.4).vertices, blob(rng(), 0.4).vertices)
    np.testing.assert_array_equal(blob(rng(), 0.4).vertices, blob(rng(), 0.4).vertices)


def test_flat_faces_keep_the_size_of_their_texture():
    mesh = box(0.3, 0.2, 0.1, texture_size=0.1)
    texels = np.array([[b - a, c - a] for a, b, c in mesh.uv[mesh.faces]])
    edges = np.array([[b - a, c - a] for a, b, c in corners(mesh)])
    np.testing.assert_allclose(np.linalg.norm(texels, axis=2), np.linalg.norm(edges, axis=2) / 0.1)
    turn = texels[:, 0, 0] * texels[:, 1, 1] - texels[:, 0, 1] * texels[:, 1, 0]
    assert (turn > 0).all()  # readable from outside, not mirrored


def test_a_sheet_faces_z_with_u_to_the_right_and_v_up():
    mesh = sheet(2, 3)
    assert (area_vectors(mesh)[:, 2] > 0).all()
    np.testing.assert_allclose(mesh.uv, mesh.vertices[:, :2] / (2, 3) + 0.5)


def test_mesh_files_are_centred_and_scaled(tmp_path):
    path = tmp_path / "box.ply"
    trimesh.creation.box((4, 2, 1)).apply_translation((9, 9, 9)).export(path)
    read = mesh_file(path, size=0.2)
    np.testing.assert_allclose(np.ptp(read.vertices, axis=0), (0.2, 0.1, 0.05))
    np.testing.assert_allclose(read.vertices.min(0) + read.vertices.max(0), 0, atol=1e-12)
    assert volume(read) == pytest.approx(0.2 * 0.1 * 0.05)
    assert np.ptp(mesh_file(path).vertices[:, 0]) == pytest.approx(4)
    with pytest.raises(FileNotFoundError, match=r"nothing.ply: no such file"):
        mesh_file(tmp_path / "nothing.ply")
    (tmp_path / "broken.ply").write_bytes(b"not a mesh")
    with pytest.raises(ValueError, match=r"broken.ply: not readable"):
        mesh_file(tmp_path / "broken.ply")


@pytest.mark.parametrize("size", [None, 0.2])
def test_a_mesh_file_of_one_point_is_refused(tmp_path, size):
    """A folder with such a mesh ended in a ZeroDivisionError."""
    path = tmp_path / "point.obj"
    path.write_text("v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"mesh .*point\.obj: all its vertices lie in one point"):
        mesh_file(path, size)
