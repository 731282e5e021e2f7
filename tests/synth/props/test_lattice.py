"""Lattice members meet at their joints and have the lengths that the geometry requires."""

import numpy as np
import pytest

from stereoweave.synth.props.lattice import (
    aviation_paints,
    bars,
    cables,
    cage,
    chain_segments,
    galvanised_steel,
    insulators,
    ladder,
    mast_levels,
    mast_rings,
    painted_steel,
    poses_towards,
    railing,
    sagging_points,
    truss,
)

UPRIGHT_M = mast_rings(np.array([0.0, 1.0, 2.0]), 1.0)


def lengths_m(segments):
    return np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)


def extent_m(mesh):
    return np.ptp(mesh.corners_m.reshape(-1, 3), axis=0)


def test_square_rings_have_their_sides_along_x_and_y():
    joints = mast_rings(np.array([0.0, 3.0]), np.array([2.0, 1.0]))
    np.testing.assert_allclose(joints[0], [[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(joints[1, 0], [0.5, 0.5, 3.0])


@pytest.mark.parametrize("corners", [3, 4, 5])
def test_the_width_of_rings_is_the_length_of_a_side(corners):
    joints = mast_rings(np.array([0.0]), 0.7, corners)[0]
    np.testing.assert_allclose(np.linalg.norm(joints - np.roll(joints, 1, axis=0), axis=1), 0.7)


@pytest.mark.parametrize(("bracing", "braces"), [("cross", 16), ("zigzag", 8), ("single", 8)])
def test_a_truss_has_the_expected_number_of_members_and_they_meet_at_the_joints(bracing, braces):
    mast = truss(UPRIGHT_M, bracing)
    assert [len(mast.legs), len(mast.struts), len(mast.braces)] == [8, 12, braces]
    ends = np.concatenate([mast.legs, mast.struts, mast.braces]).reshape(-1, 1, 3)
    assert (np.abs(ends - UPRIGHT_M.reshape(1, -1, 3)).max(2).min(1) == 0).all()


@pytest.mark.parametrize("bracing", ["cross", "zigzag", "single"])
def test_members_of_a_mast_of_unit_cubes_have_length_one_or_root_two(bracing):
    mast = truss(UPRIGHT_M, bracing)
    np.testing.assert_allclose(lengths_m(mast.legs), 1.0)
    np.testing.assert_allclose(lengths_m(mast.struts), 1.0)
    np.testing.assert_allclose(lengths_m(mast.braces), np.sqrt(2))


def test_zigzag_braces_meet_from_one_panel_to_the_next():
    lower, upper = truss(UPRIGHT_M, "zigzag").braces.reshape(2, 4, 2, 3)
    np.testing.assert_allclose(lower[:, 1], upper[:, 0])
    single = truss(UPRIGHT_M, "single").braces.reshape(2, 4, 2, 3)
    assert not np.allclose(single[0, :, 1], single[1, :, 0])


def test_a_straight_mast_has_equal_panels():
    heights, widths = mast_levels((0.0, 2.0), (1.0, 1.0), 0.5)
    np.testing.assert_allclose(heights, [0.0, 0.5, 1.0, 1.5, 2.0])
    np.testing.assert_allclose(widths, 1.0)


def test_panels_of_a_tapering_mast_keep_their_proportions():
    heights, widths = mast_levels((0.0, 6.0), (4.0, 1.0), 1.0)
    # The mean width is sqrt(4 * 1) = 2 m, so 6 m hold three panels, each 4 ** (-1 / 3) times the one below.
    assert len(heights) == 4
    assert (heights[0], heights[-1]) == (0.0, 6.0)
    np.testing.assert_allclose(np.diff(heights)[1:] / np.diff(heights)[:-1], 4 ** (-1 / 3))
    np.testing.assert_allclose(widths[1:] / widths[:-1], 4 ** (-1 / 3))


def test_every_station_is_a_joint():
    heights, widths = mast_levels((0.0, 3.1, 3.7, 5.0), (1.0, 0.4, 0.35, 0.03), 1.0)
    assert {0.0, 3.1, 3.7, 5.0} <= {round(float(z), 9) for z in heights}
    assert widths[np.isclose(heights, 3.1)] == pytest.approx(0.4)


def test_bands_take_the_materials_in_turn_and_leave_no_member_out():
    mast = truss(UPRIGHT_M, "zigzag")
    banded = mast.banded_mesh(0.02, 0.01, (5, 6), (np.inf, 1.0))
    assert len(banded.material) == len(mast.mesh(0.02, 0.01, 0).material)
    legs_and_braces = banded.corners_m[:, :, 2].mean(1)
    # Struts at 1 and 2 m belong to the band above them, so those at 2 m have the first material again.
    inside = (legs_and_braces > 0.1) & (legs_and_braces < 0.9)
    assert (banded.material[inside] == 5).all()
    inside = (legs_and_braces > 1.1) & (legs_and_braces < 1.9)
    assert (banded.material[inside] == 6).all()


def test_a_cable_keeps_its_ends_and_sags_in_its_middle():
    path = sagging_points([0.0, 0, 1], [[2.0, 0, 3], [4.0, 0, 1]], 0.5, count=4)
    np.testing.assert_allclose(path[:, 0], [[0, 0, 1], [0, 0, 1]])
    np.testing.assert_allclose(path[:, -1], [[2, 0, 3], [4, 0, 1]])
    np.testing.assert_allclose(path[:, 2], [[1, 0, 1.5], [2, 0, 0.5]])
    # A quarter of the way along, a parabola has fallen by three quarters of its sag.
    np.testing.assert_allclose(path[:, 1, 2], [1.5 - 0.375, 1 - 0.375])


def test_cables_follow_their_sagging_points():
    mesh = cables([0.0, 0, 0], [2.0, 0, 0], 0.01, 3, sag_m=0.2, count=10)
    assert mesh.corners_m[..., 2].min() == pytest.approx(-0.2, abs=0.011)
    assert (mesh.material == 3).all()


def test_chains_join_each_point_to_the_next():
    path = np.array([[[0.0, 0, 0], [1, 0, 0], [1, 2, 0]]])
    np.testing.assert_array_equal(chain_segments(path), [[[0, 0, 0], [1, 0, 0]], [[1, 0, 0], [1, 2, 0]]])


def test_uncapped_bars_have_two_triangles_per_side():
    assert len(bars(np.array([[[0.0, 0, 0], [0, 0, 1]]]), 0.1, 0, sides=5, capped=False).material) == 10


def test_a_ladder_has_a_rung_every_three_quarters_of_its_width():
    mesh = ladder((0, 0, 0), (0, 0, 3), (0, 1, 0), 0.4, 0)
    # Ten rungs (3 m / 0.3 m) have four sides of two triangles; both rails also have two caps of four.
    assert len(mesh.material) == 10 * 8 + 2 * 16
    # The axes of the rails are 0.4 m apart, and the rails have a radius of 0.03 m.
    np.testing.assert_allclose(extent_m(mesh)[1:], [0.46, 3.0], atol=1e-6)


def test_a_cage_stays_outside_its_ladder():
    mesh = cage((0, 0, 0.5), (0, 0, 2), (1, 0, 0), 0.2, 0)
    corners = mesh.corners_m.reshape(-1, 3)
    assert corners[:, 0].min() == pytest.approx(0, abs=0.01)
    assert corners[:, 0].max() == pytest.approx(1.3 * 0.2, abs=0.01)
    assert abs(corners[:, 1]).max() == pytest.approx(0.7 * 0.2, abs=0.01)


def test_a_railing_has_posts_at_its_corners_and_between_them():
    path = np.array([[0.0, 0, 1], [2.0, 0, 1]])
    mesh = railing(path, 0.5, 1.0, 0.01, 0, rails=2)
    assert len(mesh.material) == (3 + 2) * 8
    assert mesh.corners_m[..., 2].min() == pytest.approx(1.0)
    assert mesh.corners_m[..., 2].max() == pytest.approx(1.5, abs=0.011)


def test_poses_have_z_along_their_direction_and_a_level_x():
    along = np.array([[1.0, 0, 0], [0.0, 0, 2], [-1.0, 2, 0.5]])
    poses = poses_towards([1.0, 2, 3], along)
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(turns[:, :, 2], along / np.linalg.norm(along, axis=1, keepdims=True))
    np.testing.assert_allclose(turns @ turns.swapaxes(1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    np.testing.assert_allclose(turns[:, 2, 0], 0, atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 3], [[1, 2, 3]] * 3)


def test_a_string_of_insulators_reaches_from_end_to_end():
    mesh = insulators(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, 1]]), 0.1, 5, 0)
    corners = mesh.corners_m.reshape(-1, 3)
    assert corners[:, 2].max() == pytest.approx(2.0)
    # The lowest rim is above the end by 0.15 of a disc's height, which is a fifth of the string.
    assert corners[:, 2].min() == pytest.approx(1 + 0.15 * 0.2)
    assert np.linalg.norm(corners[:, :2], axis=1).max() == pytest.approx(0.1)


def test_finishes_differ_and_have_valid_tints(rng):
    finishes = [
        galvanised_steel(rng),
        painted_steel(rng, (0.95, 0.5, 0.0)),
        *aviation_paints(rng),
        galvanised_steel(rng),
    ]
    assert all(0 <= part <= 1 for finish in finishes for part in finish.tint)
    red, white = finishes[2:4]
    assert red.tint[0] > 4 * red.tint[1]
    assert min(white.tint) > 0.5
    assert finishes[0].tint != finishes[-1].tint
