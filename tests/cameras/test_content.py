from dataclasses import replace

import numpy as np
import pytest

from stereoweave.cameras.content import crop
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoCamera, StereoPair


def noise(rng):
    left, right = rng.integers(0, 256, (2, 480, 640, 3), dtype=np.uint8)
    return StereoPair(left=left, right=right)


def test_the_largest_rectangle_that_both_fill_is_kept(rng):
    camera = StereoCamera(focal_px=500, baseline_m=0.1, cx_px=310, cy_px=240, doffs_px=3)
    left_seen, right_seen = np.ones((2, 480, 640), bool)
    left_seen[:20] = False
    left_seen[470:, 630:] = False
    right_seen[:, :31] = False
    pair = replace(noise(rng), camera=camera, left_seen=left_seen, right_seen=right_seen)
    cropped = crop(pair)
    # There are two ways around the corner; leaving out its 10 rows keeps more: 450x609 versus 460x599.
    assert 460 * 599 > 450 * 609
    np.testing.assert_array_equal(cropped.left, pair.left[20:, 31:630])
    np.testing.assert_array_equal(cropped.right, pair.right[20:, 31:630])
    assert cropped.camera == replace(camera, cx_px=310 - 31, cy_px=240 - 20)
    assert cropped.left_seen is None and cropped.right_seen is None


def test_a_low_and_wide_pair_loses_no_more_than_its_border():
    image, seen = np.zeros((150, 20_000, 3), np.uint8), np.zeros((150, 20_000), bool)
    seen[3:-4, 10:-20] = True
    cropped = crop(StereoPair(left=image, right=image, left_seen=seen))
    assert cropped.left.shape == (143, 19_970, 3)


def test_a_full_pair_is_cropped_to_itself(rng):
    pair = noise(rng)
    assert crop(pair) is pair


def test_a_pair_without_a_pixel_in_both_cannot_be_cropped(rng):
    left_seen = np.zeros((480, 640), bool)
    left_seen[:, :300] = True
    with pytest.raises(StereoweaveError, match="overlap"):
        crop(replace(noise(rng), left_seen=left_seen, right_seen=~left_seen))


def test_cropping_finds_the_largest_rectangle_of_a_small_mask_by_trying_all(rng):
    for _ in range(20):
        seen = rng.random((9, 12)) < 0.8
        image = np.zeros((9, 12, 3), np.uint8)
        cropped = crop(StereoPair(left=image, right=image, left_seen=seen))
        sizes = [
            (bottom - top) * (stop - start)
            for top in range(9)
            for bottom in range(top + 1, 10)
            for start in range(12)
            for stop in range(start + 1, 13)
            if seen[top:bottom, start:stop].all()
        ]
        assert cropped.left[..., 0].size == max(sizes)
