import numpy as np
import pytest

from stereoweave.synth.props.deckhouses import House, ShipMaterials, lifebuoys, tyres, windows

PAINTS = ShipMaterials(house=0, roof=1, trim=2, white=3, dark=4, glass=5, steel=6, orange=7, rope=8)
HOUSE = House(x_m=(-1.0, 2.0), width_m=2.0, z_m=(0.0, 1.0), lean_m=(0.0, 0.5, 0.1))


def test_walls_run_from_their_lower_left_corner_seen_from_outside():
    starboard, front, port, back = HOUSE.walls_m()
    np.testing.assert_allclose(starboard, [(-1, -1, 0), (2, -1, 0), (1.5, -0.9, 1), (-1, -0.9, 1)])
    np.testing.assert_allclose(front, [(2, -1, 0), (2, 1, 0), (1.5, 0.9, 1), (1.5, -0.9, 1)])
    np.testing.assert_allclose(port[0], (2, 1, 0))
    np.testing.assert_allclose(back[0], (-1, 1, 0))


def test_a_house_encloses_its_frustum_and_its_roof():
    mesh = HOUSE.mesh(0, 1, eaves_m=0.0)
    assert np.isin(mesh.material, [0, 1]).all()
    outside = mesh.corners_m.mean(1) - (0.5, 0, 0.5)
    assert ((outside * mesh.normals.mean(1)).sum(1) > 0)[mesh.material == 0].all()
    assert mesh.corners_m[..., 2].max() == pytest.approx(1.05)


def test_panes_are_12_mm_in_front_of_the_wall_and_their_frames_6_mm():
    wall = np.array([(0.0, 0, 0), (4, 0, 0), (4, 0, 2), (0, 0, 2)])  # seen from -y
    row = windows(wall, 3, (0.4, 0.8), PAINTS)
    panes, frames = (row.corners_m[row.material == paint] for paint in (PAINTS.glass, PAINTS.dark))
    np.testing.assert_allclose(panes[..., 1], -0.012, atol=1e-6)
    np.testing.assert_allclose(frames[..., 1], -0.006, atol=1e-6)
    assert (panes[..., 2].min(), panes[..., 2].max()) == pytest.approx((0.8, 1.6))
    assert len(panes) == len(frames) == 3 * 2


def test_a_lifebuoy_lies_flat_against_its_wall_and_has_four_white_pieces():
    ring = lifebuoys(np.array([[1.0, 2, 3]]), np.array([[0.0, 1, 0]]), PAINTS)
    low, high = ring.corners_m.reshape(-1, 3).min(0), ring.corners_m.reshape(-1, 3).max(0)
    np.testing.assert_allclose(high - low, (0.38, 0.08, 0.38), atol=0.01)
    np.testing.assert_allclose((high + low) / 2, (1, 2, 3), atol=1e-3)
    assert np.mean(ring.material == PAINTS.white) == pytest.approx(1 / 3, abs=0.01)


def test_a_tyre_lies_flat_along_the_hull():
    tyre = tyres(np.array([[0.0, 1, 0]]), np.array([[1.0, 0, 0]]), PAINTS)
    size = np.ptp(tyre.corners_m.reshape(-1, 3), axis=0)
    np.testing.assert_allclose(size, (0.45, 0.12, 0.45), atol=0.02)
