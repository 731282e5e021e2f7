import numpy as np
import pytest

from stereoweave.synth.props.primitives import loft
from stereoweave.synth.props.propellers import Propeller, draw_propeller, propeller_mesh


def propeller(**changed: object) -> Propeller:
    measures = {
        "radius_m": 2.0,
        "blades": 4,
        "hub_share": 0.2,
        "pitch_share": 1.0,
        "skew_deg": 20.0,
        "rake_m": 0.1,
        "chord_m": 1.2,
        "tip": 5.0,
        "hand": 1,
    }
    return Propeller(**(measures | changed))


def volume(sections_m: np.ndarray) -> float:
    a, b, c = loft(sections_m, 0).corners_m.astype(float).swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("hand", [1, -1])
def test_a_blades_edges_lie_on_the_helix_of_its_pitch(hand):
    """From edge to edge, a section advances by 4 m per turn: its pitch equals the diameter of 4 m."""
    sections_m = propeller(hand=hand, rake_m=0.0).sections_m()[5:30]
    chords = sections_m[:, 0] - sections_m[:, 16]
    if hand == -1:
        chords = sections_m[:, -1] - sections_m[:, 15]
    angle = np.arctan2(-sections_m[..., 1], sections_m[..., 2])
    turned = angle[:, 0] - angle[:, 16] if hand == 1 else angle[:, -1] - angle[:, 15]
    np.testing.assert_allclose(chords[:, 0], hand * 4.0 * turned / (2 * np.pi), rtol=1e-6)


def test_a_left_handed_blade_is_the_mirror_image():
    right, left = propeller().sections_m(), propeller(hand=-1).sections_m()
    np.testing.assert_allclose(left[:, ::-1] * [1, -1, 1], right)


@pytest.mark.parametrize("hand", [1, -1])
def test_a_blade_has_a_plausible_volume_and_is_not_inside_out(hand):
    thick_m, area_m2 = 0.08, 1.2
    assert volume(propeller(hand=hand).sections_m()) == pytest.approx(thick_m * area_m2, rel=0.6)


def test_the_blades_reach_the_radius_and_no_further():
    mesh = propeller_mesh(propeller(), 0, 1, 2)
    reach_m = np.linalg.norm(mesh.corners_m[mesh.material == 0][..., 1:], axis=-1)
    assert reach_m.max() == pytest.approx(2.0, abs=0.01)


def test_a_propeller_is_unchanged_by_rotation_from_blade_to_blade():
    blades = propeller_mesh(propeller(blades=5), 0, 1, 2).corners_m[: 5 * 2560].reshape(5, -1, 3)
    angle = 2 * np.pi / 5
    turned = blades @ np.array(
        [[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]]
    )
    np.testing.assert_allclose(turned[:-1], blades[1:], atol=1e-5)


def test_the_hub_covers_the_blades_roots():
    for seed in range(20):
        drawn = draw_propeller(np.random.default_rng(seed))
        root = drawn.sections_m()[0]
        assert np.abs(root[:, 0]).max() < drawn.hub_half_m + drawn.rake_m
        assert np.linalg.norm(root[:, 1:], axis=1).max() < drawn.hub_m * 1.05
