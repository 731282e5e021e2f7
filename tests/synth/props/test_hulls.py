import numpy as np
import pytest

from stereoweave.synth.props.hulls import Hull

HULL = Hull(length_m=8.0, beam_m=2.4, draft_m=0.9, freeboard_m=0.7, sheer_m=(0.2, 0.6), stern=0.8, rise=0.5)


def test_the_edge_rises_by_the_sheer_towards_both_ends():
    np.testing.assert_allclose(HULL.edge_m(np.array([0.0, 0.4, 1.0])), [0.9, 0.7, 1.3])


def test_the_keel_is_a_draft_below_the_water_and_rises_at_the_stern():
    np.testing.assert_allclose(HULL.keel_m(np.array([0.0, 0.5, 1.0])), [-0.45, -0.9, -0.9])


def test_the_edge_amidships_is_half_a_beam_from_the_centre_line():
    np.testing.assert_allclose(HULL.side_m(0.42, 0.7, 1), (-0.64, 1.22, 0.7), atol=0.002)


def test_the_stem_leans_forward_by_the_rake():
    foot, head = HULL.side_m(np.array([1.0, 1.0]), np.array([-0.9, 1.3]), 1)
    assert head[0] - foot[0] == pytest.approx(HULL.rake_m)
    assert foot[0] == pytest.approx(4.0)


def test_both_sides_mirror_each_other():
    share, z = np.linspace(0, 1, 9), np.linspace(-0.4, 0.7, 9)
    np.testing.assert_array_equal(HULL.side_m(share, z, -1), HULL.side_m(share, z, 1) * [1, -1, 1])


def test_the_bow_flares():
    low, high = HULL.side_m(np.array([0.9, 0.9]), np.array([0.0, 1.0]), 1)
    assert high[1] > 1.5 * low[1]


def test_paints_meet_at_the_waterline_and_at_the_stripes_edge():
    skin = HULL.skin(0, 1, 2, stripe_m=0.15)
    heights = [skin.corners_m[skin.material == paint][..., 2] for paint in range(3)]
    assert [(h.min(), h.max()) for h in heights] == [
        pytest.approx(ends, abs=1e-6) for ends in ((-0.9, 0), (0, 0.15), (0.15, 1.3))
    ]


def test_the_skins_normals_and_triangles_face_outwards():
    skin = HULL.skin(0, 1, 2)
    middles = skin.corners_m.mean(1)
    side = np.abs(skin.normals[..., 1].mean(1)) > 0.3
    assert (middles[side, 1] * skin.normals[side].mean(1)[:, 1] > 0).all()
    a, b, c = skin.corners_m.astype(float).swapaxes(0, 1)
    agree = (np.cross(b - a, c - a)[:, None] * skin.normals).sum(-1) > 0
    assert agree.mean() > 0.99


def test_the_deck_is_below_the_edge_by_the_height_of_the_bulwark():
    deck = HULL.deck(0, 1, 2)
    floor = deck.corners_m[deck.material == 0].reshape(-1, 3)
    middle = floor[np.abs(floor[:, 0] + 0.64) < 0.2]
    np.testing.assert_allclose(middle[:, 2], 0.7 - 0.25, atol=0.01)
    assert HULL.deck_m(-0.8) == pytest.approx(0.45)
    assert deck.normals[deck.material == 0][..., 2].min() > 0.9


@pytest.mark.parametrize("side", [1, -1])
def test_a_plate_is_12_mm_in_front_of_the_skin_and_reads_from_the_left(side):
    plate = HULL.patch((48, 54), (3, 5), side, 7)
    skin = HULL.skin(0, 1, 2).corners_m.reshape(-1, 3)
    gaps = np.linalg.norm(plate.corners_m.reshape(-1, 1, 3) - skin[None], axis=-1).min(1)
    np.testing.assert_allclose(gaps, 0.012, atol=1e-4)
    assert (plate.normals[..., 1] * side > 0).all()
    # Letters run towards the bow on starboard and towards the stern on port, and stand upright.
    x, z = plate.corners_m[..., 0].ravel(), plate.corners_m[..., 2].ravel()
    u, v = plate.uv_m[..., 0].ravel(), plate.uv_m[..., 1].ravel()
    assert np.corrcoef(u, -side * x)[0, 1] > 0.99
    assert np.corrcoef(v, z)[0, 1] > 0.9
