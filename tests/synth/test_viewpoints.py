import numpy as np
import pytest

from stereoweave.stereo import StereoCamera
from stereoweave.synth.viewpoints import (
    Orbit,
    Viewpoint,
    draw_focal_px,
    draw_nearest_px,
    draw_viewpoint,
    interpolate_viewpoints,
    place_rig,
)

CAMERA = StereoCamera(focal_px=500.0, baseline_m=0.2, cx_px=319.5, cy_px=239.5)
ORBIT = Orbit(centre_m=(1.0, 2.0, 3.0), distance_m=(4.0, 9.0))


def viewpoint(**changes):
    values = {
        "distance_m": 5.0,
        "azimuth_deg": 0.0,
        "elevation_deg": 0.0,
        "aim_m": np.array([1.0, 2.0, 3.0]),
        "roll_deg": 0.0,
    }
    return Viewpoint(**(values | changes))


def rig(orbit=ORBIT, **changes):
    return place_rig(orbit, viewpoint(**changes), CAMERA, (640, 480))


def test_a_level_rig_east_of_its_aim_looks_west_with_north_at_its_right():
    made = rig()
    np.testing.assert_allclose(made.axes, [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(made.eye_m(0.5), [6, 2, 3], atol=1e-12)


def test_the_right_camera_is_a_baseline_to_the_right_of_the_left_one():
    made = rig()
    np.testing.assert_allclose(made.eye_m(1.0) - made.eye_m(0.0), [0, 0.2, 0], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_axes_are_orthonormal_and_right_handed_and_the_aim_is_straight_ahead(seed):
    drawn = draw_viewpoint(np.random.default_rng(seed), ORBIT)
    made = place_rig(ORBIT, drawn, CAMERA, (640, 480))
    np.testing.assert_allclose(made.axes @ made.axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(made.axes[0], made.axes[1]), made.axes[2], atol=1e-12)
    ahead = made.axes @ (drawn.aim_m - made.eye_m(0.5))
    assert np.abs(ahead[:2]).max() < 1e-9 < ahead[2]


def test_a_rolled_rig_has_its_right_camera_lower():
    made = rig(roll_deg=30.0)
    assert made.axes[0, 2] == pytest.approx(-0.5)


def test_cameras_stay_above_the_floor_of_their_orbit():
    made = rig(elevation_deg=-80.0, aim_m=np.array([1.0, 2.0, 2.0]))
    assert made.eye_m(0.5)[2] == pytest.approx(ORBIT.floor_m)


def test_viewpoints_are_within_the_ranges_of_their_orbit():
    orbit = Orbit(
        centre_m=(0, 0, 1), distance_m=(4, 9), azimuth_deg=(10, 20), elevation_deg=(-3, 5), aim_m=0.5
    )
    for seed in range(50):
        drawn = draw_viewpoint(np.random.default_rng(seed), orbit)
        assert 4 <= drawn.distance_m <= 9
        assert 10 <= drawn.azimuth_deg <= 20
        assert -3 <= drawn.elevation_deg <= 5
        assert np.linalg.norm(drawn.aim_m - [0, 0, 1]) <= 0.5


def test_a_moving_camera_starts_and_stops_gently_and_is_halfway_at_half_time():
    start, end = viewpoint(), viewpoint(distance_m=7.0, azimuth_deg=40.0)
    assert interpolate_viewpoints(start, end, 0.0).azimuth_deg == 0
    assert interpolate_viewpoints(start, end, 0.5).azimuth_deg == 20
    assert interpolate_viewpoints(start, end, 1.0).distance_m == 7
    # At time t near the start, the camera has covered 3 t^2 of the way.
    assert interpolate_viewpoints(start, end, 0.01).azimuth_deg == pytest.approx(40 * 3e-4, rel=0.01)


def test_focal_lengths_give_fields_of_view_of_42_to_72_degrees():
    rng = np.random.default_rng(0)
    focal_px = np.array([draw_focal_px(rng, 640) for _ in range(200)])
    field_deg = 2 * np.degrees(np.arctan(320 / focal_px))
    assert 42 <= field_deg.min() < 45
    assert 69 < field_deg.max() <= 72


def test_half_of_the_nearest_disparities_are_below_the_geometric_mean_of_their_range():
    rng = np.random.default_rng(0)
    nearest_px = np.array([draw_nearest_px(rng, 640) for _ in range(2000)])
    assert nearest_px.min() >= 18 and nearest_px.max() <= 160
    assert (nearest_px < np.sqrt(18 * 160)).mean() == pytest.approx(0.5, abs=0.03)
