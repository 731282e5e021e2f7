from dataclasses import replace

import numpy as np
import pytest
from learn_examples import complaint

from stereoweave.stereo import StereoCamera
from stereoweave.synth.scenes import SCENES
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_stage_and_rig, render_pair
from stereoweave.synth.stage import Stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Mesh, RenderedView, Sky, World

SPEC = RenderSpec(scene="propeller", size_px=(320, 240))
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
    """A renderer that shows a wall 4 m away from any position."""

    name = "wall"

    def depth_m(self, world, rig, position):
        return np.full(rig.size_px[::-1], 4.0, np.float32)

    def render_views(self, world, rig, positions):
        return []


@pytest.mark.parametrize("index", [0, 1])
def test_a_given_rig_stands_where_a_drawn_one_would(index):
    _, fixed = draw_stage_and_rig(Wall(), replace(SPEC, rig=(260.0, 0.5)), index)
    _, drawn = draw_stage_and_rig(Wall(), SPEC, index)
    assert fixed.camera == StereoCamera(focal_px=260.0, baseline_m=0.5, cx_px=159.5, cy_px=119.5)
    assert drawn.camera != fixed.camera
    np.testing.assert_allclose(fixed.eye_m(0.5), drawn.eye_m(0.5))
    np.testing.assert_array_equal(fixed.axes, drawn.axes)


def test_a_drawn_rig_has_a_nearest_disparity_of_18_to_160_px_per_640_px_of_width():
    nearest_px = [
        draw_stage_and_rig(Wall(), SPEC, index)[1].camera.disparity_px(np.array([[4.0]]))
        for index in range(4)
    ]
    assert all(9 <= px <= 80 for px in np.ravel(nearest_px))


def test_a_scene_may_set_its_own_range_of_the_nearest_disparity(monkeypatch):
    monkeypatch.setitem(SCENES, "propeller", lambda rng: replace(STAGE, nearest_px=(100.0, 100.0)))
    _, rig = draw_stage_and_rig(Wall(), SPEC, 0)
    np.testing.assert_allclose(rig.camera.disparity_px(np.array([[4.0]])), 50.0)  # at a width of 320 px


class Grey(Wall):
    """A renderer whose left view is plain white and whose right view is plain black."""

    def render_views(self, world, rig, positions):
        levels = [np.full((*rig.size_px[::-1], 3), 255 * (position == 0), np.uint8) for position in positions]
        known = np.ones(rig.size_px[::-1], bool)
        return [
            RenderedView(image=level, depth_m=4 * known.astype(np.float32), target=known) for level in levels
        ]


def test_noise_grows_with_the_root_of_brightness_and_depends_on_the_seed(monkeypatch):
    assert render_pair(Grey(), SPEC, 0).sample.left.min() == 255
    monkeypatch.setitem(SCENES, "propeller", lambda rng: replace(STAGE, noise_levels=4.0))
    sample = render_pair(Grey(), SPEC, 0).sample
    # White and black clip half of the noise, which leaves a mean of 0.399 standard deviations.
    assert (255 - sample.left).mean() == pytest.approx(0.399 * 4, rel=0.05)
    assert sample.right.mean() == pytest.approx(0.399 * 4 * 0.2**0.5, rel=0.05)
    np.testing.assert_array_equal(render_pair(Grey(), SPEC, 0).sample.left, sample.left)
    assert not np.array_equal(render_pair(Grey(), SPEC, 1).sample.left, sample.left)


class Wire(Wall):
    """A wall 4 m away, in front of which the right camera sees a wire at a fraction of that depth."""

    def __init__(self, share):
        self.share = share

    def depth_m(self, world, rig, position):
        depth_m = super().depth_m(world, rig, position)
        if rig.camera.baseline_m > 1e-3 and position == 1.0:
            depth_m[:, :2] *= self.share  # 0.6 % of the image
        return depth_m


@pytest.mark.parametrize(("share", "shrunk"), [(1.0, 1.0), (0.9, 1.0), (0.5, 0.5 * 1.25), (0.1, 0.1 * 1.25)])
def test_a_wire_close_to_one_camera_limits_its_disparity_to_a_quarter_above_the_drawn_one(share, shrunk):
    (_, wired), (_, clear) = (draw_stage_and_rig(camera, SPEC, 0) for camera in (Wire(share), Wall()))
    assert wired.camera.baseline_m == pytest.approx(shrunk * clear.camera.baseline_m)
    assert wired.camera.focal_px == clear.camera.focal_px


@pytest.mark.parametrize(
    ("rig", "told"),
    [
        ((0.0, 0.5), "focal_px: expected a number above 1e-09, found 0"),
        ((260.0, -0.5), "baseline_m: expected a number above 1e-09, found -0.5"),
        ((float("inf"), 0.5), "camera parameters must be finite"),
    ],
)
def test_an_invalid_rig_is_refused(rig, told):
    assert told in complaint(lambda: replace(SPEC, rig=rig))
