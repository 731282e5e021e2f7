"""Depth carried to the frames between two matched ones: a textured square passes in front of a plane."""

import cv2
import numpy as np
import pytest
from plain_carrying import plain_locate, plain_take

from stereoweave.stereo import Estimate, StereoPair
from stereoweave.video.carried_frames import WEIGHTS, carry_between
from stereoweave.video.carried_kernels import Source, locate, take_pixels
from stereoweave.video.motion import Motion
from stereoweave.video.temporal_filter import TemporalFilter

HEIGHT, WIDTH = 120, 176
NEAR_PX, FAR_PX = 30, 10


def texture(rng, height=HEIGHT, width=WIDTH):
    image = cv2.GaussianBlur(rng.uniform(0, 255, (height, width, 3)), (0, 0), 1.5)
    return np.clip(128 + 4 * (image - 128), 0, 255).astype(np.uint8)


class Passing:
    """Frames of a square of 48 px that moves to the right in front of a plane."""

    def __init__(self, rng, velocity_px):
        self._back, self._front, self._velocity_px = (
            texture(rng, width=WIDTH + 20),
            texture(rng, 48, 48),
            velocity_px,
        )

    def frame(self, number):
        """Return the pair, and the true estimate."""
        images, maps = [], []
        for position in (0, 1):
            column = 50 + round(self._velocity_px * number) - position * NEAR_PX
            image = self._back[:, position * FAR_PX : position * FAR_PX + WIDTH].copy()
            disparity_px = np.full((HEIGHT, WIDTH), FAR_PX, np.float32)
            image[36:84, column : column + 48] = self._front
            disparity_px[36:84, column : column + 48] = NEAR_PX
            images.append(image)
            maps.append(disparity_px)
        confidence = np.full((HEIGHT, WIDTH), 0.8, np.float32)
        truth = Estimate(
            disparity_px=maps[0],
            right_disparity_px=maps[1],
            confidence=confidence,
            occluded=np.zeros((HEIGHT, WIDTH), bool),
        )
        return StereoPair(left=images[0], right=images[1]), truth


def matched(video, *numbers):
    """Return the filtered frames with these numbers."""
    temporal_filter, found = TemporalFilter(1), []
    for number in numbers:
        pair, truth = video.frame(number)
        temporal_filter(pair.left, pair.right, truth)
        found.append(temporal_filter.last)
    return found


@pytest.mark.parametrize("velocity_px", [0, 2, -3])
def test_frames_between_have_the_depth_of_what_they_show(rng, velocity_px):
    video = Passing(rng, velocity_px)
    before, after = matched(video, 0, 3)
    frames = [video.frame(number) for number in (1, 2)]
    found = carry_between([pair for pair, _ in frames], before, after, 2)
    for estimate, (_, truth) in zip(found, frames, strict=True):
        for name in ("disparity_px", "right_disparity_px"):
            error_px = np.abs(getattr(estimate, name) - getattr(truth, name))
            # Flow at half size is not accurate to the pixel at the edges of the square.
            assert (error_px > 1).mean() < 0.015
            assert np.median(error_px) < 1e-5


def test_depth_that_changes_steadily_is_interpolated_in_time(rng):
    pair, truth = Passing(rng, 0).frame(0)
    temporal_filter, found = TemporalFilter(1), []
    for change_px in (0.0, 0.9):
        values = {
            name: getattr(truth, name) + np.float32(change_px)
            for name in ("disparity_px", "right_disparity_px")
        }
        each = Estimate(confidence=truth.confidence, occluded=truth.occluded, **values)
        temporal_filter(pair.left, pair.right, each)
        found.append(temporal_filter.last)
    carried = carry_between([pair, pair], *found, 1)
    for estimate, expected_px in zip(carried, (0.3, 0.6), strict=True):
        middle = estimate.disparity_px[60, 20]
        assert middle == pytest.approx(FAR_PX + expected_px, abs=0.02)


def test_nothing_lies_between_neighbours(rng):
    (only,) = matched(Passing(rng, 0), 0)
    assert carry_between([], None, only, 2) == []


@pytest.mark.parametrize("shape", [(20, 26), (21, 17)])
@pytest.mark.parametrize("towards", [-1, 1])
def test_the_kernel_equals_its_plain_version(rng, shape, towards):
    own, other, *greys = (rng.integers(0, 256, shape).astype(np.uint8) for _ in range(4))
    sources = [
        Source(
            grey,
            rng.choice([5.0, 5.4, 7.3, 12.0], shape).astype(np.float32),
            rng.uniform(0, 1, shape).astype(np.float32),
            rng.integers(0, shape[0] * shape[1], shape).astype(np.int32),
        )
        for grey in greys
    ]
    found = np.full((2, *shape), np.nan, np.float32)
    take_pixels(own, other, towards, *sources, 0.3, WEIGHTS, *found)
    expected = plain_take(own, other, towards, sources, 0.3, WEIGHTS)
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("shape", [(20, 26), (21, 17)])
def test_pixels_are_looked_up_along_the_camera_s_motion_or_else_along_flow(rng, shape):
    half = (shape[0] + 1) // 2, (shape[1] + 1) // 2
    # Exact halves are excluded, because NumPy and the kernel may round them differently.
    flow_px = (rng.integers(-4, 5, (*half, 2)) + rng.uniform(-0.4, 0.4, (*half, 2))).astype(np.float32)
    explained, calm, rests = (rng.random(half) < 0.7 for _ in range(3))
    source = rng.integers(-1, shape[0] * shape[1], shape).astype(np.int32)
    places = np.empty(shape, np.int32)
    locate(Motion(flow_px, explained, calm, 1.0, rests), source, places)
    np.testing.assert_array_equal(places, plain_locate(flow_px, explained & rests, source))
