"""The shipped network on pairs that it cannot match: its maps are finite, and its confidence is low."""

from pathlib import Path

import numpy as np
import pytest

import stereoweave as sw
from stereoweave.io.images import read_image
from stereoweave.learn.data.collage import paint_collage

SIZE = (192, 320)
TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
UNSEEN_SEED = 4_000_037


def flat(level: int) -> np.ndarray:
    return np.full((*SIZE, 3), level, np.uint8)


def estimate(left, right):
    found = sw.Matcher(threads=1).estimate(np.ascontiguousarray(left), np.ascontiguousarray(right))
    for values in (found.disparity_px, found.right_disparity_px, found.confidence):
        assert np.isfinite(values).all()
    return found


@pytest.mark.parametrize(("left", "right"), [(0, 0), (255, 255), (0, 255), (128, 128)])
def test_plain_pictures_give_finite_maps_without_any_confidence(left, right):
    assert estimate(flat(left), flat(right)).confidence.max() == 0


def test_a_photograph_beside_a_black_picture_is_not_trusted():
    left = read_image(TEXTURED / "left.png")
    for pictures in ((left, np.zeros_like(left)), (np.zeros_like(left), left)):
        assert estimate(*pictures).confidence.mean() < 0.1


@pytest.mark.parametrize("spread", [2, 10, 40, None])
def test_noise_is_not_trusted(rng, spread):
    found = []
    for _ in range(8):  # single pairs differ by a factor of two
        if spread is None:
            left, right = rng.integers(0, 256, (2, *SIZE, 3), np.uint8)
        else:
            left, right = np.clip(rng.normal(128, spread, (2, *SIZE, 3)), 0, 255).astype(np.uint8)
        found.append(estimate(left, right).confidence)
    assert np.mean(found) < 0.4
    assert (np.array(found) > 0.5).mean() < 0.1


def test_identical_pictures_are_at_disparity_0():
    left = read_image(TEXTURED / "left.png")
    found = estimate(left, left)
    assert np.percentile(found.disparity_px, 99) < 1
    assert np.percentile(found.right_disparity_px, 99) < 1
    assert found.confidence.mean() > 0.9
    assert found.occluded.mean() < 0.01


def test_pictures_of_two_scenes_are_not_trusted():
    one, other = (paint_collage(UNSEEN_SEED, 2, index, *SIZE) for index in (0, 1))
    assert estimate(one.left, other.right).confidence.mean() < 0.2


@pytest.mark.parametrize("shift_px", [300, 340, 400])
def test_surfaces_nearer_than_the_range_are_not_trusted(shift_px):
    wide = paint_collage(UNSEEN_SEED, 3, 0, 256, 1040).left
    found = estimate(wide[:, :640], wide[:, shift_px : shift_px + 640])
    assert found.confidence.mean() < 0.25


def test_surfaces_behind_the_range_are_not_trusted():
    wide = paint_collage(UNSEEN_SEED, 3, 0, 256, 700).left
    found = estimate(wide[:, 40:680], wide[:, :640])
    assert found.confidence.mean() < 0.2
