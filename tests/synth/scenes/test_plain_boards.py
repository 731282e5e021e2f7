from functools import partial

import numpy as np
import pytest

from stereoweave.synth.rendering.effects import PLAIN
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.scenes.plain_boards import plain_boards
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_stage_and_rig, render_pair

SPEC = RenderSpec(scene="boards", seed=77, size_px=(160, 120))
PAIRS = range(12)
# A training crop of 384x256, as a fraction of an image of 640x480.
CROP = 0.32


@pytest.fixture(scope="module")
def camera():
    return Raycaster(PLAIN)


@pytest.fixture(scope="module")
def left_views(camera):
    """Return each pair's depth, its disparity at a width of 640 px, and the mask of near plain surfaces."""
    views = []
    for index in PAIRS:
        stage, rig = draw_stage_and_rig(camera, SPEC, index)
        (shot,) = camera.render_views(stage.world, rig, (0.0,))
        views.append((shot.depth_m, 4 * rig.camera.disparity_px(shot.depth_m), shot.target))
    return views


def test_near_plain_surfaces_are_larger_than_a_training_crop_in_most_pairs(left_views):
    shares = [plain.mean() for _, _, plain in left_views]
    assert np.median(shares) > 0.5
    assert sum(share > CROP for share in shares) >= 0.8 * len(shares)
    assert max(shares) < 0.99  # an outline is always visible


def test_near_plain_surfaces_have_20_to_120_px_of_disparity(left_views):
    middles_px = [np.median(disparity_px[plain]) for _, disparity_px, plain in left_views]
    assert min(middles_px) > 15
    assert max(middles_px) < 120
    assert np.ptp(middles_px) > 40


def test_nothing_touches_the_cameras_and_the_room_is_closed(left_views):
    assert min(depth_m.min() for depth_m, _, _ in left_views) > 0.35
    assert max(depth_m.max() for depth_m, _, _ in left_views) < 12


def test_the_target_is_plain_and_most_of_the_rest_is_not():
    plain_families, other_families = [], []
    for seed in range(6):
        world = plain_boards(np.random.default_rng(seed)).world
        families = np.array([material.texture for material in world.materials])
        areas = partial(np.linalg.norm, axis=1)
        a, b, c = world.mesh.corners_m.swapaxes(0, 1)
        area = areas(np.cross(b - a, c - a))
        even = families[world.mesh.material] == "plain"
        plain_families.append(area[even & world.mesh.target].sum() / area[world.mesh.target].sum())
        other_families.append(area[even & ~world.mesh.target].sum() / area[~world.mesh.target].sum())
    assert min(plain_families) > 0.85
    assert np.mean(other_families) < 0.5


def test_both_cameras_have_independent_noise_and_the_ground_truth_has_none(camera):
    stage, rig = draw_stage_and_rig(camera, SPEC, 0)
    ideal = [shot.image.astype(float) for shot in camera.render_views(stage.world, rig, (0.0, 1.0))]
    sample = render_pair(camera, SPEC, 0).sample
    noise = [seen - image for seen, image in zip((sample.left, sample.right), ideal, strict=True)]
    assert 0.5 <= stage.noise_levels <= 1.5
    for levels in noise:
        assert 0.4 * stage.noise_levels < levels.std() < 1.1 * stage.noise_levels
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.05
    np.testing.assert_allclose(
        sample.disparity_px, rig.camera.disparity_px(camera.depth_m(stage.world, rig, 0.0)), rtol=1e-6
    )
