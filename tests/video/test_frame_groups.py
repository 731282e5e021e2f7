"""Groups of frames, each of which ends with a frame to match."""

from fractions import Fraction

import cv2
import numpy as np
import pytest

from stereoweave.video.frame_groups import FrameGrouper
from stereoweave.video.reader import StereoFrame
from stereoweave.video.shot_alignment import ShotAligner


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


def rows_apart(rng, count, down_px):
    """Return frames of a shot whose right picture lies some rows lower."""
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (240, 340, 3)), (0, 0), 1.5)
    wide = np.clip(128 + 4 * (wide - 128), 0, 255).astype(np.uint8)
    right = np.roll(wide[:, 10:330], down_px, axis=0)
    return [StereoFrame(wide[:, :320], right, Fraction(number, 25), None) for number in range(count)]


def rows_of(pair):
    """Return by how many rows the right picture lies lower, at most 12."""
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(float) for image in (pair.left, pair.right))
    inner = np.s_[40:-40, 60:-60]
    moves = range(-12, 13)
    return min(
        moves,
        key=lambda rows: min(
            np.abs(np.roll(right, (-rows, columns), (0, 1))[inner] - left[inner]).mean()
            for columns in range(0, 25)
        ),
    )


def test_a_shot_too_plain_to_be_measured_keeps_its_rows_up_to_the_next_shot(rng):
    grey = np.full((240, 320, 3), 90, np.uint8)
    marked = [grey.copy() for _ in range(3)]
    plain = [StereoFrame(image, image, Fraction(number, 25), None) for number, image in enumerate(marked)]
    frames = [*plain, *rows_apart(rng, 4, 6)]
    grouper = FrameGrouper(ShotAligner())
    pairs = [pair for group in grouper(frames) for pair in group.pairs]
    assert len(pairs) == len(frames)
    for pair, frame in zip(pairs[:3], plain, strict=True):
        assert pair.right is frame.right
    assert [rows_of(pair) for pair in pairs[3:]] == [0, 0, 0, 0]


def test_a_restored_grouper_goes_on_with_the_same_groups(rng, tmp_path):
    frames, more = shot(rng, 4), shot(rng, 4)
    grouper = FrameGrouper(None)
    list(grouper(frames))
    np.savez(tmp_path / "state.npz", **grouper.state())
    with np.load(tmp_path / "state.npz") as arrays:
        again = FrameGrouper.from_state(dict(arrays))
    assert sizes(again(frames)) == [3, 1]
    assert sizes(grouper(more)) == [1, 1, 1, 1]
