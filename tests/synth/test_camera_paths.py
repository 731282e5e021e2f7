from dataclasses import replace

import numpy as np
import pytest

from stereoweave.stereo import StereoCamera
from stereoweave.synth.camera_paths import FRAMES_PER_S, CameraPath, draw_path
from stereoweave.synth.scenes import SCENES
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_world_poses
from stereoweave.synth.viewpoints import Orbit, place_rig

ORBIT = Orbit(
    centre_m=(0.0, 0.0, 2.0),
    distance_m=(4.0, 9.0),
    azimuth_deg=(10, 50),
    elevation_deg=(-30, 20),
    floor_m=0.5,
)
CAMERA = StereoCamera(focal_px=264.0, baseline_m=0.5, cx_px=159.5, cy_px=119.5)


def draw_positions(path, orbit, frames):
    viewpoints = [path.viewpoint(frame / FRAMES_PER_S) for frame in range(frames)]
    rigs = [place_rig(orbit, viewpoint, CAMERA, (320, 240)) for viewpoint in viewpoints]
    return np.stack([rig.eye_m(0.5) for rig in rigs])


def test_a_value_is_at_its_middle_at_phase_0_and_at_its_reach_a_quarter_turn_later():
    ones = np.ones(7)
    path = CameraPath(middle=10 * ones, reach=2 * ones, phase=0 * ones, rate_per_s=np.pi / 2 * ones)
    assert path.viewpoint(0.0).azimuth_deg == 10
    later = path.viewpoint(1.0)
    assert (later.azimuth_deg, later.elevation_deg, later.distance_m, later.roll_deg) == (12, 12, 12, 12)
    np.testing.assert_array_equal(later.aim_m, [12, 12, 12])
    assert path.viewpoint(3.0).azimuth_deg == 8


@pytest.mark.parametrize("seed", range(3))
def test_a_path_stays_in_its_orbit_s_ranges_and_the_nearer_half_of_the_distances(seed):
    path = draw_path(np.random.default_rng(seed), ORBIT)
    drawn = [path.viewpoint(time_s) for time_s in np.linspace(0, 600, 2000)]
    azimuths, distances = [v.azimuth_deg for v in drawn], [v.distance_m for v in drawn]
    assert 10 <= min(azimuths) < 11 and 49 < max(azimuths) <= 50
    assert 4 <= min(distances) < 4.1 and 5.9 < max(distances) <= 6  # the root of 4 * 9 is 6
    assert all(np.linalg.norm(v.aim_m - [0, 0, 2]) <= 0.5 for v in drawn)


def test_a_path_does_not_touch_the_floor_of_its_orbit():
    path = draw_path(np.random.default_rng(0), ORBIT)
    # The floor is 1.5 m below the centre: 14.48 degrees at a distance of 6 m, and 22 degrees at 4 m.
    lowest_deg = min(path.viewpoint(time_s).elevation_deg for time_s in np.linspace(0, 600, 2000))
    assert lowest_deg == pytest.approx(-np.degrees(np.arcsin(1.5 / 6)), abs=0.1)
    assert draw_positions(path, ORBIT, 600)[:, 2].min() > 0.5


def test_a_path_in_a_full_circle_covers_60_degrees():
    orbit = Orbit(centre_m=(0, 0, 2), distance_m=(4, 9))
    path = draw_path(np.random.default_rng(1), orbit)
    azimuths = [path.viewpoint(time_s).azimuth_deg for time_s in np.linspace(0, 600, 2000)]
    assert np.ptp(azimuths) == pytest.approx(60, abs=0.1)
    assert min(azimuths) >= 0 and max(azimuths) <= 360


@pytest.mark.parametrize("scene", ["antenna", "propeller"])
def test_the_rig_moves_smoothly_at_a_fifteenth_of_its_distance_per_second(scene):
    stage = SCENES[scene](np.random.default_rng(4))
    path = draw_path(np.random.default_rng(5), stage.orbit, (7.0, 8.0))
    moved_m = np.diff(draw_positions(path, stage.orbit, 6000), axis=0)
    steps_m = np.linalg.norm(moved_m, axis=1)
    assert np.sqrt((steps_m**2).mean()) * FRAMES_PER_S == pytest.approx(0.5, rel=0.1)
    # From one frame to the next, the step changes by less than a millimetre.
    assert np.linalg.norm(np.diff(moved_m, axis=0), axis=1).max() < 1e-3


def test_a_path_does_not_depend_on_how_long_it_is_followed():
    spec = RenderSpec(scene="antenna", seed=1, size_px=(320, 240), frames=9, by_world=True)
    longer, shorter = draw_world_poses(spec, 0), draw_world_poses(replace(spec, frames=5), 0)
    assert len(shorter) == 5
    for one, other in zip(longer, shorter, strict=False):
        assert one.time_s == other.time_s
        np.testing.assert_array_equal(one.position_m, other.position_m)
        np.testing.assert_array_equal(one.axes, other.axes)
