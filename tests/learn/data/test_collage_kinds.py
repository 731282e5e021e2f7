import cv2
import numpy as np
import pytest

from stereoweave.learn.data.collage import paint_scene
from stereoweave.learn.data.collage_kinds import CollageCanvas, draw_scene, draw_street, draw_training_scene
from stereoweave.learn.data.collage_layers import draw_paint, draw_plain_paint, draw_unfocused_paint
from stereoweave.learn.data.collage_scene import CollageLayer, CollageScene, CollageSurface
from stereoweave.learn.data.silhouettes import Placement, cover_canvas

HEIGHT, WIDTH = 320, 512


@pytest.fixture(scope="module")
def painted():
    """Return disparity, its limit, and the left image of 100 scenes of the size used in training."""
    scenes = [draw_training_scene(np.random.default_rng((7, index)), HEIGHT, WIDTH) for index in range(100)]
    views = [(paint_scene(scene)[0], scene.layers[0].surface.limit_px) for scene in scenes]
    return [(view.disparity_px, limit_px, view.image) for view, limit_px in views]


def gradient(image):
    """Return the magnitude of the gradient in grey levels per pixel."""
    grey = image.mean(axis=2)
    return np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8


def far_from_texture(image):
    return cv2.distanceTransform((gradient(image) < 1).astype(np.uint8), cv2.DIST_L2, 5) > 32


def wall(paint, height=96, width=128):
    surface = CollageSurface(plane=(5.0, 0.0, 0.0, 0.0, 0.0), limit_px=10.0)
    layer = CollageLayer(patch=cover_canvas(width + 12, height), surface=surface, paint=paint)
    return paint_scene(CollageScene(layers=(layer,), height=height, width=width))[0].image


@pytest.mark.parametrize("draw", [draw_scene, draw_training_scene])
@pytest.mark.parametrize("width", [384, 704, 1440])
def test_no_disparity_exceeds_the_networks_reach_at_any_width(draw, width):
    # Few rows, because only the width matters and painting takes time.
    for index in range(60):
        scene = draw(np.random.default_rng((9, index)), 64, width)
        greatest_px = max(layer.surface.over(layer.patch).max(initial=0) for layer in scene.layers)
        assert greatest_px <= 188


@pytest.mark.parametrize("draw", [draw_scene, draw_training_scene])
def test_the_range_of_a_narrow_pair_shrinks_with_its_width(draw):
    # 190 px for 384 columns are 95 px for 192.
    for index in range(60):
        scene = draw(np.random.default_rng((9, index)), 96, 192)
        assert max(layer.surface.over(layer.patch).max(initial=0) for layer in scene.layers) <= 95


def test_plain_areas_are_not_always_far(painted):
    # A crop of 256x384 pixels, as in training.
    cut = np.s_[32:288, 64:448]
    deep = [far_from_texture(image[cut]) for _, _, image in painted]
    nearness = [(d[cut] / limit_px)[plain] for (d, limit_px, _), plain in zip(painted, deep, strict=True)]
    assert np.mean(deep) > 0.06
    assert 0.4 < np.median(np.concatenate(nearness)) < 0.8


def test_the_share_of_the_left_view_outside_the_right_one_is_as_in_real_pairs(painted):
    outside = [(np.arange(WIDTH) < disparity_px).mean() for disparity_px, _, _ in painted]
    assert 0.055 < np.mean(outside) < 0.085
    assert np.quantile(outside, 0.25) < 0.03 and np.quantile(outside, 0.9) > 0.1


def test_a_plain_paint_has_hardly_any_texture_and_an_unfocused_paint_no_fine_texture(rng):
    place = Placement(64, 48, 64, 128, 96)
    matt = np.zeros(6, np.float32)
    plain = [gradient(wall(draw_plain_paint(rng, place)._replace(gloss=matt))) for _ in range(20)]
    unfocused = [gradient(wall(draw_unfocused_paint(rng, place)._replace(gloss=matt))) for _ in range(20)]
    sharp = [gradient(wall(draw_paint(rng, place)._replace(gloss=matt))) for _ in range(20)]
    assert np.mean(np.array(plain) < 1.5) > 0.95
    assert np.mean(unfocused) < np.mean(sharp) / 2


def test_a_street_rises_from_the_horizon_to_the_nearest_below():
    canvas = CollageCanvas(view_width=192, height=128, limit_px=40.0)
    skies = 0
    for index in range(20):
        layers = draw_street(np.random.default_rng(index), canvas)
        layers.sort(key=lambda layer: layer.surface.plane[0])
        disparity_px = paint_scene(CollageScene(layers=tuple(layers), height=128, width=192))[0].disparity_px
        # The bottom edge has at least half of the limit, and the last row is at most 1/51 short of it.
        assert disparity_px[-1].min() >= 0.5 * 40 * 50 / 51
        skies += disparity_px.min() == 0
    assert skies >= 15


def test_an_object_on_a_street_has_the_disparity_of_its_foot():
    canvas = CollageCanvas(view_width=192, height=128, limit_px=40.0)
    for index in range(20):
        sky, ground, *others = draw_street(np.random.default_rng(index), canvas)
        flat = [layer.surface for layer in others if layer.surface.plane[1:3] == (0.0, 0.0)]
        assert sky.surface.plane[0] == 0 and flat
        for surface in flat:
            level_px, _, _, foot_x, foot_y = surface.plane
            assert level_px == pytest.approx(ground.surface.plane_px(foot_x, foot_y))
            assert level_px > 0
