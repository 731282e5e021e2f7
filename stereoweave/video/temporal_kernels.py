"""Kernels of the temporal filter (`temporal_filter`)."""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

MOST_FRAMES = 12.0
"""Maximum number of frames in a mean. The limit lets the mean follow slow changes."""
LEAST_WEIGHT = 0.1
"""A frame counts as its confidence, but at least this much."""
LEAST_RIVAL = 1.2
"""A rival needs more than this to win, which takes two frames at least."""
DOUBTED_SHARE = 0.5
"""A frame less confident than this share of the mean is in doubt, whatever moves."""
SAME_PX, SAME_SHARE = 1.0, 0.02
"""Frames show the same surface if their disparities differ by at most SAME_PX + SAME_SHARE * disparity."""
NEIGHBOUR_PX = 3.0
"""Neighbours belong to the same surface if their disparities differ by less than this."""
STEP_PX, STEPS = 8, 2
"""Spacing of the grid of sampled neighbours, and the number of steps in each direction."""


class Track(typing.NamedTuple):
    """Filtered state of one view; arrays are float32 [H, W].

    Attributes:
        disparity_px: Mean disparity over the frames.
        confidence: Mean confidence; a frame that contradicts the mean counts as 0.
        frames: Number of frames in the mean, each weighted by its confidence; 0 where the disparity is
            unknown.
        offset_px: float32 [H, W, 2], place of the point to the right of and below the pixel's centre.
        rival_px: Mean disparity over the frames that contradict the mean and agree with each other.
        rival_frames: Weighted number of these frames, minus that of frames that contradicted them
            afterwards; 0 if there is no rival.
    """

    disparity_px: np.ndarray
    confidence: np.ndarray
    frames: np.ndarray
    offset_px: np.ndarray
    rival_px: np.ndarray
    rival_frames: np.ndarray


@kernel
@typing.no_type_check
def carry(new_px, track, motion, source, source_offset_px, carried):
    """Warp `track` to the new frame and write it to `carried`, with 0 frames where nothing is known.

    Where the camera's motion explains the image, a pixel takes the point of `source` (`splat_kernels.splat`).

    Motion is not accurate to the pixel. Outside calm areas, each pixel therefore takes its value from
    whichever of the nine pixels around its previous position has the disparity closest to `new_px` [H, W].
    """
    old_px, old_confidence, old_frames = track.disparity_px, track.confidence, track.frames
    disparity_px, confidence, frames = carried.disparity_px, carried.confidence, carried.frames
    offset_px = carried.offset_px
    old_rival_px, old_rival_frames = track.rival_px, track.rival_frames
    rival_px, rival_frames = carried.rival_px, carried.rival_frames
    to_before_px, explained, calm, rests = motion.to_before_px, motion.explained, motion.calm, motion.rests
    height, width = new_px.shape
    for y in range(height):
        for x in range(width):
            i, j = y // 2, x // 2
            disparity_px[y, x] = confidence[y, x] = frames[y, x] = 0.0
            rival_px[y, x] = rival_frames[y, x] = 0.0
            offset_px[y, x, 0] = offset_px[y, x, 1] = 0.0
            index = source[y, x]
            if index >= 0 and rests[i, j] and explained[i, j]:
                row, column = index // width, index % width
                disparity_px[y, x] = old_px[row, column]
                confidence[y, x] = old_confidence[row, column]
                frames[y, x] = old_frames[row, column]
                rival_px[y, x] = old_rival_px[row, column]
                rival_frames[y, x] = old_rival_frames[row, column]
                offset_px[y, x, 0] = source_offset_px[y, x, 0]
                offset_px[y, x, 1] = source_offset_px[y, x, 1]
                continue
            row = int(round(y + to_before_px[i, j, 1]))
            column = int(round(x + to_before_px[i, j, 0]))
            if not explained[i, j] or row < 0 or row >= height or column < 0 or column >= width:
                continue
            if not calm[i, j]:
                middle_row, middle_column = row, column
                # A neighbour must be clearly better than the centre, so that noise does not shift the map
                # back and forth.
                least_px = abs(old_px[row, column] - new_px[y, x]) - 0.5
                for near_row in range(max(middle_row - 1, 0), min(middle_row + 2, height)):
                    for near_column in range(max(middle_column - 1, 0), min(middle_column + 2, width)):
                        apart_px = abs(old_px[near_row, near_column] - new_px[y, x])
                        if apart_px < least_px:
                            least_px = apart_px
                            row, column = near_row, near_column
            disparity_px[y, x] = old_px[row, column]
            confidence[y, x] = old_confidence[row, column]
            frames[y, x] = old_frames[row, column]
            rival_px[y, x] = old_rival_px[row, column]
            rival_frames[y, x] = old_rival_frames[row, column]


@kernel
@typing.no_type_check
def measure_drift(new_px, carried, drift_px):
    """Write the disparity change of the surface around every second pixel to `drift_px` [H2, W2].

    The result is the mean change in the neighbourhood, shrunk by the James-Stein estimator: the mean times
    1 - (standard error / mean) ** 2, or 0 where that factor is negative.
    """
    old_px, frames = carried.disparity_px, carried.frames
    height, width = new_px.shape
    for i in range(drift_px.shape[0]):
        for j in range(drift_px.shape[1]):
            here_px = new_px[2 * i, 2 * j]
            total_px = total_px2 = 0.0
            count = 0
            for y in range(2 * i - STEPS * STEP_PX, 2 * i + STEPS * STEP_PX + 1, STEP_PX):
                for x in range(2 * j - STEPS * STEP_PX, 2 * j + STEPS * STEP_PX + 1, STEP_PX):
                    if 0 <= y < height and 0 <= x < width and frames[y, x] > 0:
                        change_px = new_px[y, x] - old_px[y, x]
                        if abs(change_px) < NEIGHBOUR_PX and abs(new_px[y, x] - here_px) < NEIGHBOUR_PX:
                            total_px += change_px
                            total_px2 += change_px * change_px
                            count += 1
            drift_px[i, j] = 0.0
            if count > 1:
                mean_px = total_px / count
                doubt_px2 = (total_px2 / count - mean_px**2) / (count - 1)
                if mean_px**2 > doubt_px2:
                    drift_px[i, j] = mean_px - doubt_px2 / mean_px


@kernel
@typing.no_type_check
def blend(new, carried, calm, drift_px, mean):
    """Combine `carried` with the new frame, and write the updated track to `mean`.

    In calm areas, and where the new frame is in doubt, a frame that contradicts the mean counts for the
    rival, which becomes the mean when more frames are for it. Elsewhere, such a frame starts a new mean.
    """
    new_px, new_confidence = new.disparity_px, new.confidence
    old_px, old_confidence, old_frames = carried.disparity_px, carried.confidence, carried.frames
    disparity_px, confidence, frames = mean.disparity_px, mean.confidence, mean.frames
    old_offset_px, offset_px = carried.offset_px, mean.offset_px
    old_rival_px, old_rival_frames = carried.rival_px, carried.rival_frames
    rival_px, rival_frames = mean.rival_px, mean.rival_frames
    height, width = new_px.shape
    for y in range(height):
        for x in range(width):
            change_px = drift_px[y // 2, x // 2]
            expected_px, rival = old_px[y, x] + change_px, old_rival_px[y, x] + change_px
            count, rival_count = old_frames[y, x], old_rival_frames[y, x]
            same_px = SAME_PX + SAME_SHARE * abs(new_px[y, x])
            apart_px = new_px[y, x] - expected_px
            weight = max(new_confidence[y, x], LEAST_WEIGHT)
            contradicts = count > 0 and abs(apart_px) > same_px
            doubted = calm[y // 2, x // 2] or weight < DOUBTED_SHARE * old_confidence[y, x]
            moved = 0.0
            if contradicts and doubted:
                rival, rival_count = _count_rival(new_px[y, x], weight, same_px, rival, rival_count)
                moved = 1.0
                disparity_px[y, x], frames[y, x] = expected_px, count
                confidence[y, x] = old_confidence[y, x] * count / (count + weight)
                rival_px[y, x], rival_frames[y, x] = rival, rival_count
                if rival_count > max(count, LEAST_RIVAL):
                    moved = 0.0
                    disparity_px[y, x], frames[y, x] = rival, rival_count
                    confidence[y, x] = new_confidence[y, x]
                    rival_px[y, x], rival_frames[y, x] = expected_px, count
            else:
                if contradicts or count == 0:
                    count = rival_count = 0.0
                else:
                    moved = 1.0
                rival_px[y, x], rival_frames[y, x] = rival, max(rival_count - 0.5 * weight, 0.0)
                count = min(count + weight, MOST_FRAMES)
                share = weight / count
                disparity_px[y, x] = new_px[y, x] - (1.0 - share) * apart_px
                more = new_confidence[y, x] - old_confidence[y, x]
                confidence[y, x] = old_confidence[y, x] + share * more
                frames[y, x] = count
            # A new mean is of points at the pixels' centres.
            offset_px[y, x, 0] = moved * old_offset_px[y, x, 0]
            offset_px[y, x, 1] = moved * old_offset_px[y, x, 1]


@inlined
@typing.no_type_check
def _count_rival(new_px, weight, same_px, rival_px, count):
    """Return the rival's disparity and frames after a frame that contradicts the mean."""
    if count > 0 and abs(new_px - rival_px) <= same_px:
        return rival_px + weight / (count + weight) * (new_px - rival_px), count + weight
    if count > weight:
        return rival_px, count - weight
    return new_px, weight
