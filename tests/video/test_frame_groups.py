"""Groups of frames, each of which ends with a frame to match."""

from fractions import Fraction

import cv2
import numpy as np
import pytest

from stereoweave.video.frame_groups import FrameGrouper
from stereoweave.video.reader import StereoFrame


def texture(rng):
    image = cv2.GaussianBlur(rng.uniform(0, 255, (96, 128, 3)), (0, 0), 1.5)
    return np.clip(128 + 4 * (image - 128), 0, 255).astype(np.uint8)


def shot(rng, count):
    left, right = texture(rng), texture(rng)
    return [StereoFrame(left, right, Fraction(number, 25), None) for number in range(count)]


def sizes(groups):
    return [len(group.frames) for group in groups]


def test_the_first_frame_every_third_one_and_the_last_are_matched(rng):
    frames = shot(rng, 9)
    groups = list(FrameGrouper(None)(frames))
    assert sizes(groups) == [1, 3, 3, 2]
    assert [frame for group in groups for frame in group.frames] == frames
    assert all(pair.left is frame.left for group in groups for frame, pair in zip(*group, strict=True))


@pytest.mark.parametrize(("before", "expected"), [(5, [1, 3, 1, 1, 1, 2]), (4, [1, 3, 1, 1, 1, 3])])
def test_depth_is_not_carried_across_a_cut(rng, before, expected):
    frames = shot(rng, before) + shot(rng, 9 - before + (before == 4))
    assert sizes(FrameGrouper(None)(frames)) == expected


def test_a_restored_grouper_goes_on_with_the_same_groups(rng, tmp_path):
    frames, more = shot(rng, 4), shot(rng, 4)
    grouper = FrameGrouper(None)
    list(grouper(frames))
    np.savez(tmp_path / "state.npz", **grouper.state())
    with np.load(tmp_path / "state.npz") as arrays:
        again = FrameGrouper.from_state(dict(arrays))
    assert sizes(again(frames)) == [3, 1]
    assert sizes(grouper(more)) == [1, 1, 1, 1]
