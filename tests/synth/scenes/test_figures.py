import numpy as np
import pytest

from stereoweave.synth.props.people_and_animals import animal
from stereoweave.synth.scenes.figures import figures
from stereoweave.synth.stage import Palette
from stereoweave.synth.viewpoints import draw_viewpoint

SEEDS = range(8)


@pytest.mark.parametrize("seed", SEEDS)
def test_an_animal_is_about_a_metre_long_and_stands_on_the_ground(seed):
    corners_m = animal(np.random.default_rng(seed), Palette()).corners_m.reshape(-1, 3)
    assert 0.9 < np.ptp(corners_m[:, 0]) < 2.2
    assert corners_m[:, 2].min() == pytest.approx(0.03, abs=0.08)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_nearest_figure_is_close_to_the_cameras_but_never_touches_them(seed):
    rng = np.random.default_rng(seed)
    stage = figures(rng)
    corners_m = stage.world.mesh.corners_m[stage.world.mesh.target].reshape(-1, 3)
    nearest_m = []
    for _ in range(20):
        place = draw_viewpoint(rng, stage.orbit)
        azimuth, elevation = np.radians([place.azimuth_deg, place.elevation_deg])
        outwards = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        eye_m = np.array(stage.orbit.centre_m) + place.distance_m * outwards
        eye_m[2] = max(eye_m[2], stage.orbit.floor_m)
        nearest_m.append(np.linalg.norm(corners_m - eye_m, axis=1).min())
    assert 0.25 < min(nearest_m) < 2.5


def test_half_of_the_scenes_are_indoors():
    halls = [bool(figures(np.random.default_rng(seed)).world.lamps) for seed in range(40)]
    assert 12 <= sum(halls) <= 28
