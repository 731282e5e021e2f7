import numpy as np
import pytest

from stereoweave.synth.props.people_and_animals import draw_clothes, person
from stereoweave.synth.props.streets import StreetPlan, carriageway, draw_street_plan, fronts, traffic
from stereoweave.synth.scenes.street import street
from stereoweave.synth.stage import Palette
from stereoweave.synth.viewpoints import draw_viewpoint

PLAN = StreetPlan(half_m=5.0, pavement_m=2.5, lane_m=-1.5)


@pytest.fixture(params=range(6))
def rng(request):
    return np.random.default_rng(request.param)


def test_the_carriageway_is_level_at_z_0_between_its_kerbs(rng):
    mesh = carriageway(rng, Palette(), PLAN)
    tops_m = mesh.corners_m[mesh.normals[:, 0, 2] > 0.9]
    inside_m = tops_m[(abs(tops_m[..., 1]) <= 5.001).all(1)]
    assert -1e-6 <= inside_m[..., 2].min() <= inside_m[..., 2].max() < 0.02
    pavement_m = tops_m[abs(tops_m[..., 1]).mean(1) > 5.001]
    np.testing.assert_allclose(pavement_m[..., 2], 0.12, atol=1e-6)


def test_house_fronts_stay_off_the_pavements(rng):
    house_m = fronts(rng, Palette(), PLAN).corners_m
    low_m = house_m[(house_m[..., 2] < 2.0).all(1)]
    # Window bars and frames protrude from the wall by 10 cm, and bushes protrude over the fence by more.
    assert abs(low_m[..., 1]).min() > PLAN.half_m + 0.5 * PLAN.pavement_m


def test_vehicles_stand_on_the_carriageway(rng):
    corners_m = traffic(rng, Palette(), PLAN).corners_m
    assert corners_m[..., 2].min() == pytest.approx(0, abs=0.02)
    assert abs(corners_m[..., 1]).max() < PLAN.half_m + 1.0


def test_traffic_keeps_to_one_side_of_the_middle_with_room_for_a_parked_car(rng):
    plan = draw_street_plan(rng)
    assert abs(plan.lane_m) + 2.1 < plan.half_m


def test_people_have_realistic_heights_and_stand_on_the_ground(rng):
    clothes = draw_clothes(rng, Palette())
    corners_m = person(rng, clothes).corners_m
    assert corners_m[..., 2].min() == pytest.approx(0, abs=0.03)
    assert 1.5 < corners_m[..., 2].max() < 2.0


def test_the_cameras_drive_between_the_parked_cars_and_look_along_the_street(rng):
    stage = street(rng)
    for _ in range(10):
        place = draw_viewpoint(rng, stage.orbit)
        assert 160 < place.azimuth_deg < 200
        y = stage.orbit.centre_m[1] + place.distance_m * np.sin(np.radians(place.azimuth_deg))
        assert abs(y) < 6.5
    corners_m = stage.world.mesh.corners_m[stage.world.mesh.target]
    eye_m = np.array([-stage.orbit.distance_m[0], stage.orbit.centre_m[1], stage.orbit.centre_m[2]])
    assert np.linalg.norm(corners_m - eye_m, axis=-1).min() > 0.5
