import subprocess
import sys

import numpy as np
import pytest

from stereoweave.synth.props.primitives import (
    boxes,
    copies,
    facets,
    lathe,
    loft,
    orthogonal_frames,
    polyline_tubes,
    prism,
    rotation,
    sheet,
    spheres,
    sweep,
    translation,
    tubes,
)
from stereoweave.synth.world import Mesh, join_meshes

ANGLE = np.linspace(0, 2 * np.pi, 64, endpoint=False)
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE], -1)
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def volume(mesh: Mesh) -> float:
    """Return the volume of a closed surface, which is negative if the surface is inside out."""
    a, b, c = mesh.corners_m.astype(float).swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


def area(mesh: Mesh) -> float:
    a, b, c = mesh.corners_m.astype(float).swapaxes(0, 1)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def faces(mesh: Mesh) -> np.ndarray:
    a, b, c = mesh.corners_m.astype(float).swapaxes(0, 1)
    across = np.cross(b - a, c - a)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


PIECES = {
    "a tube": (tubes([0, 0, 0], [0, 0, 2], 0.5, 0, sides=128), np.pi * 0.25 * 2),
    "a cone": (tubes([1, 0, 0], [1, 0, 3], [[1.0, 0.0]], 0, sides=128), np.pi),
    "tubes askew": (tubes([[0, 0, 0], [1, 2, 3]], [[0, 0, 1], [2, 4, 5]], 0.1, 0, 128), np.pi * 0.01 * 4),
    "boxes": (boxes([[0, 0, 0], [3, 0, 0]], [[1, 2, 3], [1, 1, 1]], 0), 7.0),
    "a lathed drum": (lathe([(0, 0), (1, 0), (1, 2), (0, 2)], 0, 128), 2 * np.pi),
    "a lathed cone": (lathe([(0, 0), (1, 0), (0, 3)], 0, 128), np.pi),
    "a lofted column": (loft(np.stack([CIRCLE + [0, 0, z] for z in (0, 0.5, 2)]), 0), 2 * np.pi),
    "a lofted pyramid's frustum": (loft(np.stack([2 * SQUARE, SQUARE + [0, 0, 3]]), 0), 28.0),
    "a straight pipe": (sweep(np.linspace([0, 0, 0], [3, 4, 0], 9), 0.2, 0, 128), np.pi * 0.04 * 5),
    "balls": (spheres([[0, 0, 0], [5, 0, 0]], [1.0, 0.5], 0, 4), 4 / 3 * np.pi * 1.125),
    "an ellipsoid": (spheres([0, 0, 0], [[1.0, 2.0, 3.0]], 0, 4), 8 * np.pi),
    "a prism": (prism([(0, 0), (2, 0), (0, 2)], 3, 0), 6.0),
    "a bent wire": (polyline_tubes([(0, 0, 0), (0, 0, 1), (0, 1, 1)], 0.1, 0, 128), np.pi * 0.01 * 2),
}


@pytest.mark.parametrize("name", PIECES)
def test_a_piece_encloses_the_volume_that_the_formula_gives(name):
    mesh, expected = PIECES[name]
    assert volume(mesh) == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("name", PIECES)
def test_normals_are_unit_vectors_that_point_outwards(name):
    mesh, _ = PIECES[name]
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-6)
    assert (faces(mesh)[:, None] * mesh.normals).sum(-1).min() > 0


@pytest.mark.parametrize("name", PIECES)
def test_a_piece_is_float32_has_its_material_and_is_not_a_target(name):
    mesh, _ = PIECES[name]
    assert {mesh.corners_m.dtype, mesh.normals.dtype, mesh.uv_m.dtype} == {np.dtype(np.float32)}
    assert not mesh.material.any()
    assert not mesh.target.any()


def test_a_tube_without_caps_is_only_its_wall():
    wall = tubes([0, 0, 0], [0, 0, 2], 0.5, 0, sides=128, capped=False)
    assert area(wall) == pytest.approx(2 * np.pi, rel=0.001)


def test_the_caps_of_a_tube_are_two_discs():
    whole = area(tubes([0, 0, 0], [0, 0, 2], 0.5, 0, sides=128))
    assert whole == pytest.approx(2 * np.pi + 2 * np.pi * 0.25, rel=0.001)


def test_texture_coordinates_of_a_tube_are_in_metres():
    wall = tubes([0, 0, 0], [0, 0, 2.5], 0.5, 0, sides=128, capped=False)
    np.testing.assert_allclose(np.ptp(wall.uv_m.reshape(-1, 2), axis=0), (np.pi, 2.5), rtol=1e-5)


def test_a_box_rotated_by_90_degrees_swaps_length_and_breadth():
    box = boxes([1, 0, 0], [4, 2, 1], 0, rotation((0, 0, 1), 90)[None, :3, :3])
    corners = box.corners_m.reshape(-1, 3)
    np.testing.assert_allclose((corners.min(0), corners.max(0)), [(0, -2, -0.5), (2, 2, 0.5)], atol=1e-6)


def test_a_lathed_drum_keeps_its_sharp_edges_and_smooths_gentle_ones():
    drum = lathe([(1, 0), (1, 1), (0.999, 2), (0, 2)], 0, 16)
    heights = drum.corners_m[..., 2]
    assert set(np.round(np.abs(drum.normals[heights == 2][:, 2]), 2)) == {0.0, 1.0}
    gentle = drum.normals[heights == 1][:, 2]
    np.testing.assert_allclose(gentle, 0.0005, atol=1e-5)  # halfway between 0 and 0.001


def test_a_bent_pipe_has_the_volume_of_a_torus_and_is_round_all_along():
    angle = np.linspace(0, np.pi, 60)
    pipe = sweep(np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0 * angle], -1), 0.2, 0, 64)
    assert volume(pipe) == pytest.approx(np.pi * 0.04 * np.pi * 3, rel=0.01)
    x, y, z = pipe.corners_m.reshape(-1, 3).T
    from_axis = np.hypot(np.hypot(x, y) - 3, z)
    assert from_axis.max() == pytest.approx(0.2, abs=0.002)


def test_an_open_loft_lacks_its_two_ends():
    rings = np.stack([CIRCLE + [0, 0, z] for z in (0, 2)])
    assert area(loft(rings, 0)) - area(loft(rings, 0, capped=False)) == pytest.approx(2 * np.pi, rel=0.002)


def test_a_sheet_with_x_along_columns_and_y_along_rows_faces_up():
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    flat = sheet(np.stack([x, y, 0 * x], -1), 3)
    assert (flat.normals == (0, 0, 1)).all()
    assert (faces(flat) == (0, 0, 1)).all()
    assert area(flat) == pytest.approx(12)
    np.testing.assert_allclose(flat.uv_m, flat.corners_m[..., :2])


def test_a_closed_sheet_has_no_crease_where_its_columns_meet():
    ring = np.concatenate([CIRCLE, CIRCLE[:1]])
    tube = sheet(np.stack([ring, ring + [0, 0, 1]]), 0, closed=True)
    np.testing.assert_allclose(tube.normals[..., :2], tube.corners_m[..., :2], atol=1e-5)


def test_facets_are_flat():
    slope = facets([[(0, 0, 0), (1, 0, 0), (0, 1, 1)]], 0)
    np.testing.assert_allclose(slope.normals[0], [(0, -(0.5**0.5), 0.5**0.5)] * 3, atol=1e-6)


def test_copies_equal_meshes_that_are_placed_one_by_one():
    piece = join_meshes([boxes([1, 2, 3], [1, 2, 3], 0), tubes([0, 0, 0], [1, 1, 1], 0.2, 5).as_target()])
    poses = np.stack(
        [rotation((1, 2, 3), 50) @ translation(3, 4, 5), translation(z=2) @ np.diag([2.0, 2, 2, 1])]
    )
    both, one_by_one = copies(piece, poses), join_meshes([piece.transform(pose) for pose in poses])
    np.testing.assert_allclose(both.corners_m, one_by_one.corners_m, atol=2e-6)
    np.testing.assert_allclose(both.normals, one_by_one.normals, atol=2e-6)
    assert (both.material == one_by_one.material).all()
    assert (both.target == one_by_one.target).all()


def test_a_quarter_turn_about_z_takes_x_to_y():
    np.testing.assert_allclose(rotation((0, 0, 1), 90) @ (1, 0, 0, 1), (0, 1, 0, 1), atol=1e-12)


def test_a_translation_moves_points_by_its_metres():
    np.testing.assert_allclose(translation(1, 2, 3) @ (10, 20, 30, 1), (11, 22, 33, 1))


def test_frames_are_right_handed_and_their_first_vector_is_level():
    along = np.array([[1.0, 0, 0], [0.0, 0, 1], [0, 0, -1], [0.6, 0, 0.8], [0.04, 0.0, 0.9992]])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across, other = orthogonal_frames(along)
    turns = np.stack([across, other, along], -1)
    np.testing.assert_allclose(turns @ turns.swapaxes(1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    np.testing.assert_allclose(across[:, 2], 0, atol=1e-12)


def test_a_ball_of_twenty_faces_is_a_regular_icosahedron():
    ball = spheres([0, 0, 0], 1.0, 0, subdivisions=0)
    edges = np.linalg.norm(ball.corners_m - np.roll(ball.corners_m, 1, axis=1), axis=-1)
    np.testing.assert_allclose(edges, np.full((20, 3), 1 / np.sin(2 * np.pi / 5)), rtol=1e-6)


def test_each_subdivision_of_a_ball_splits_every_face_into_four_on_the_sphere():
    ball = spheres([1, 2, 3], 0.5, 0, subdivisions=2)
    assert len(ball.corners_m) == 20 * 4**2
    np.testing.assert_allclose(np.linalg.norm(ball.corners_m - [1, 2, 3], axis=-1), 0.5, rtol=1e-6)


def test_making_and_checking_sets_does_not_import_slow_modules():
    slow = ["scipy", "networkx", "trimesh", "numba", "skimage"]
    program = (
        "import sys, stereoweave.synth.sets.check, stereoweave.synth.sets.make\n"
        "from stereoweave.synth.props.primitives import spheres\n"
        f"spheres([0, 0, 0], 1.0, 0); print([name for name in {slow} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
