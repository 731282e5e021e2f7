"""A turbine head has three blades of the requested length and pitch, with marked tips."""

import numpy as np
import pytest

from stereoweave.synth.props.wind_rotors import (
    OVERHANG_M,
    Rotor,
    TurbineMaterials,
    composite_skin,
    turbine_head,
)

FINISH = TurbineMaterials(white=0, tip=1, steel=2, dark=3, lamp=4)


def blades_m(**changes):
    """Return the corners more than 0.7 m from the axis, which are the blades', for a level axis."""
    measures = {
        "radius_m": 2.0,
        "chord_m": 0.24,
        "pitch_deg": 0.0,
        "angle_deg": 0.0,
        "tilt_deg": 0.0,
    } | changes
    mesh = turbine_head(Rotor(**measures), FINISH)
    corners = mesh.corners_m.reshape(-1, 3) - np.array([OVERHANG_M, 0, 0.17])
    return corners[np.linalg.norm(corners[:, 1:], axis=1) > 0.7]


def test_blades_reach_the_rotors_radius():
    radius_m = np.linalg.norm(blades_m()[:, 1:], axis=1)
    assert radius_m.max() == pytest.approx(2.0, abs=0.003)


def test_the_three_blades_are_a_third_of_a_turn_apart():
    corners = blades_m(angle_deg=20.0)
    tips = corners[np.linalg.norm(corners[:, 1:], axis=1) > 1.95]
    around = np.degrees(np.arctan2(-tips[:, 1], tips[:, 2])) % 120
    assert around.min() > 18
    assert around.max() < 22


def test_feathered_blades_are_narrow_from_the_front_and_others_from_the_side():
    upright = [corners[corners[:, 2] > 1.2] for corners in (blades_m(), blades_m(pitch_deg=90.0))]
    (across, along), (across_feathered, along_feathered) = (
        (np.ptp(blade[:, 1]), np.ptp(blade[:, 0])) for blade in upright
    )
    assert across > 2 * across_feathered
    assert along_feathered > 1.5 * along


def test_marked_tips_are_bands_of_whole_rings():
    mesh = turbine_head(Rotor(radius_m=2.0, chord_m=0.24, pitch_deg=0, angle_deg=0, tilt_deg=0), FINISH)
    # The 22 stations are from 0.1 to 2 m; bands lie between the 15th and the 19th, and beyond the 21st.
    station_m = np.linspace(0.1, 2.0, 22)
    marked = mesh.corners_m[mesh.material == 1] - np.array([OVERHANG_M, 0, 0.17])
    height_m = marked[marked[..., 2].min(1) > 1.0][..., 2]  # of the upright blade
    np.testing.assert_allclose(np.unique(height_m.round(4)), station_m[[14, 15, 16, 17, 18, 20, 21]].round(4))


def test_composite_skin_is_light_grey(rng):
    tint = composite_skin(rng).tint
    assert 0.6 < min(tint) <= max(tint) < 0.9
