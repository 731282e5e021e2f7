from dataclasses import replace

import numpy as np
import pytest
from learn_examples import complaint

from stereoweave.stereo import StereoCamera
from stereoweave.synth.rigs import Orbit
from stereoweave.synth.samples import Order, staged
from stereoweave.synth.scenes import SCENES
from stereoweave.synth.stage import Stage
from stereoweave.synth.world import Mesh, Sky, World

ORDER = Order(scene="propeller", size_px=(320, 240))
TRIANGLE = Mesh(
    corners_m=np.eye(3, dtype=np.float32)[None],
    normals=np.full((1, 3, 3), 3**-0.5, np.float32),
    uv_m=np.zeros((1, 3, 2), np.float32),
    material=np.zeros(1, np.int32),
    target=np.ones(1, bool),
)
SKY = Sky(sun=(0, 0, 1), sun_light=(1, 1, 1), zenith=(1, 1, 1), horizon=(1, 1, 1), ground=(1, 1, 1))
STAGE = Stage(
    world=World(mesh=TRIANGLE, materials=(), sky=SKY),
    orbit=Orbit(centre_m=(0.0, 0.0, 1.0), distance_m=(5.0, 9.0)),
)


@pytest.fixture(autouse=True)
def small_scene(monkeypatch):
    monkeypatch.setitem(SCENES, "propeller", lambda rng: STAGE)


class Wall:
    """A camera that sees a wall 4 m away, wherever it stands."""

    def depth_m(self, world, rig, position):
        return np.full(rig.size_px[::-1], 4.0, np.float32)

    def shots(self, world, rig, positions):
        return []


@pytest.mark.parametrize("index", [0, 1])
def test_a_given_rig_takes_every_pair_from_where_any_rig_stands(index):
    _, fixed = staged(Wall(), replace(ORDER, rig=(260.0, 0.5)), index)
    _, drawn = staged(Wall(), ORDER, index)
    assert fixed.camera == StereoCamera(focal_px=260.0, baseline_m=0.5, cx_px=159.5, cy_px=119.5)
    assert drawn.camera != fixed.camera
    np.testing.assert_allclose(fixed.eye_m(0.5), drawn.eye_m(0.5))
    np.testing.assert_array_equal(fixed.axes, drawn.axes)


def test_a_drawn_rig_has_its_nearest_disparity_between_18_and_160_px_of_640():
    nearest_px = [
        staged(Wall(), ORDER, index)[1].camera.disparity_px(np.array([[4.0]])) for index in range(4)
    ]
    assert all(9 <= px <= 80 for px in np.ravel(nearest_px))


@pytest.mark.parametrize("rig", [(0.0, 0.5), (260.0, -0.5), (float("inf"), 0.5)])
def test_a_rig_that_cannot_be_is_refused(rig):
    assert "must be" in complaint(lambda: replace(ORDER, rig=rig))
