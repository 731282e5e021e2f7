"""Temporal filter of videos, each a list of (left, right, estimate) with random textures and seeded noise."""

import threading

import cv2
import numpy as np
import pytest

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate
from stereoweave.video.motion import Motion
from stereoweave.video.temporal_filter import TemporalFilter
from stereoweave.video.temporal_kernels import (
    DOUBTED_SHARE,
    LEAST_RIVAL,
    LEAST_WEIGHT,
    MOST_FRAMES,
    NEIGHBOUR_PX,
    SAME_PX,
    SAME_SHARE,
    STEP_PX,
    STEPS,
    Track,
    blend,
    carry,
    measure_drift,
)

HEIGHT, WIDTH = 120, 176
# A pixel with odd coordinates is not among the neighbours from which drift is measured.
PIXEL = (61, 83)


def texture(rng, height=HEIGHT, width=WIDTH):
    image = cv2.GaussianBlur(rng.uniform(0, 255, (height, width, 3)), (0, 0), 1.5)
    return np.clip(128 + 4 * (image - 128), 0, 255).astype(np.uint8)


def estimate(disparity_px, right_disparity_px=None, confidence=0.8):
    disparity_px = np.asarray(disparity_px, np.float32)
    right_px = disparity_px if right_disparity_px is None else np.asarray(right_disparity_px, np.float32)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=right_px,
        confidence=np.full(disparity_px.shape, confidence, np.float32),
        occluded=np.zeros(disparity_px.shape, bool),
    )


def plain(value_px, at_pixel_px=None):
    disparity_px = np.full((HEIGHT, WIDTH), value_px, np.float32)
    disparity_px[PIXEL] = value_px if at_pixel_px is None else at_pixel_px
    return estimate(disparity_px)


def filter_all(video):
    temporal_filter = TemporalFilter()
    return [temporal_filter(*frame) for frame in video], temporal_filter


def assert_unchanged(found, frame):
    *_, expected = frame
    for name in ("disparity_px", "right_disparity_px", "confidence"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def disparities(estimates):
    return np.stack([each.disparity_px for each in estimates])


def at_rest(rng, estimates):
    left, right = texture(rng), texture(rng)
    return [(left, right, each) for each in estimates]


def square_video(rng, frames, velocity_px, nearing_px=0.0):
    """Return a video of a textured square in front of a plane, its true disparities, and the square's masks.

    The square is 48 px wide and begins at a disparity of 30 px; the plane is at 10 px.
    """
    back, front = texture(rng), texture(rng, 48, 48)
    video, truths_px, masks = [], [], []
    for number in range(frames):
        near_px = 30 + nearing_px * number
        images, maps, squares = [], [], []
        for position in (0, 1):
            # The square lies on whole pixels in both views.
            column = 60 + round(velocity_px * number - position * (near_px - 10))
            image, square = back.copy(), np.zeros((HEIGHT, WIDTH), bool)
            image[36:84, column : column + 48], square[36:84, column : column + 48] = front, True
            noise_px = rng.normal(0, 0.3, square.shape)
            images.append(np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8))
            maps.append(np.where(square, near_px, 10.0) + noise_px)
            squares.append(square)
        video.append((*images, estimate(*maps)))
        truths_px.append(np.where(squares[0], near_px, 10.0))
        masks.append(squares[0])
    return video, np.stack(truths_px), np.stack(masks)


def test_the_first_estimate_is_unchanged(rng):
    video = at_rest(rng, [estimate(rng.uniform(0, 40, (HEIGHT, WIDTH)))])
    assert_unchanged(filter_all(video)[0][0], video[0])


def test_a_pixel_at_rest_becomes_the_mean_of_its_frames(rng):
    video = at_rest(rng, [plain(10, 10.0), plain(10, 10.6), plain(10, 10.0), plain(10, 9.8)])
    found = disparities(filter_all(video)[0])
    np.testing.assert_allclose(found[:, *PIXEL], [10.0, 10.3, 10.2, 10.1], atol=1e-5)
    assert (np.delete(found.reshape(4, -1), PIXEL[0] * WIDTH + PIXEL[1], axis=1) == 10).all()


def test_a_change_shared_by_a_surface_is_followed_without_lag(rng):
    found = disparities(filter_all(at_rest(rng, [plain(10 + 0.5 * t) for t in range(8)]))[0])
    np.testing.assert_allclose(found[:, 50, 60], 10 + 0.5 * np.arange(8), atol=1e-5)


def test_at_rest_a_contradiction_is_outvoted_until_it_has_lasted_equally_long(rng):
    video = at_rest(rng, [plain(10), plain(10), *[plain(10, 40)] * 4])
    found = disparities(filter_all(video)[0])
    np.testing.assert_allclose(found[:, *PIXEL], [10, 10, 10, 10, 40, 40], atol=1e-5)


def test_a_contradiction_lowers_the_confidence(rng):
    video = at_rest(rng, [plain(10), plain(10, 40), plain(10)])
    found = [each.confidence[PIXEL] for each in filter_all(video)[0]]
    # The contradiction counts as 0 beside one frame of 0.8; then follows the mean of 0.4 and 0.8.
    np.testing.assert_allclose(found, [0.8, 0.4, 0.6], atol=1e-6)


def test_disparities_that_contradict_each_other_do_not_outvote_the_mean(rng):
    values_px = [10, 40, 20, 60, 30, 50, 80]
    found = disparities(filter_all(at_rest(rng, [plain(10, px) for px in values_px]))[0])
    np.testing.assert_allclose(found[:, *PIXEL], 10, atol=1e-5)


def test_a_confident_rival_outvotes_a_doubtful_mean_after_two_frames(rng):
    video = at_rest(rng, [plain(10) for _ in range(5)] + [plain(10, 40) for _ in range(3)])
    for *_, each in video[:5]:
        each.confidence[PIXEL] = 0.1
    found = disparities(filter_all(video)[0])
    # The mean counts 5 * 0.1 frames, the rival 0.8, then 1.6, which is above 0.5 and above LEAST_RIVAL.
    np.testing.assert_allclose(found[4:, *PIXEL], [10, 10, 40, 40], atol=1e-5)


def test_flicker_of_a_still_video_at_least_halves_in_both_views(rng):
    left, right = texture(rng), texture(rng)
    video = []
    for _ in range(12):
        noisy = (
            np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8) for image in (left, right)
        )
        video.append((*noisy, estimate(*(10 + rng.normal(0, 0.3, (2, HEIGHT, WIDTH))))))
    found = filter_all(video)[0]
    for name in ("disparity_px", "right_disparity_px"):
        before, after = (
            np.abs(np.diff([getattr(each, name) for each in maps], axis=0)).mean()
            for maps in ([each for *_, each in video], found)
        )
        assert after < 0.5 * before


@pytest.mark.parametrize(("velocity_px", "nearing_px"), [(4, 0), (-3, 0), (1, 0), (2, 1)])
def test_moving_objects_leave_no_trail(rng, velocity_px, nearing_px):
    video, truth_px, moving = square_video(rng, 10, velocity_px, nearing_px)
    found = disparities(filter_all(video)[0])
    error_px = np.abs(found - truth_px)[1:]
    error_by_frame_px = np.abs(disparities([each for *_, each in video]) - truth_px)[1:]
    uncovered = moving[:-1] & ~moving[1:]
    assert error_px[moving[1:]].mean() <= error_by_frame_px[moving[1:]].mean()
    assert error_px[uncovered].mean() <= 1.02 * error_by_frame_px[uncovered].mean()
    assert error_px.mean() < 0.7 * error_by_frame_px.mean()


def test_an_approaching_object_is_followed_without_lag(rng):
    video, truth_px, moving = square_video(rng, 12, 0, nearing_px=0.5)
    found = disparities(filter_all(video)[0])
    inside = cv2.erode(moving[0].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    lag_px = (truth_px - found)[1:, inside].mean(axis=1)
    assert np.abs(lag_px).max() < 0.1


def test_a_pan_is_filtered_along_its_motion(rng):
    wide = texture(rng, HEIGHT, WIDTH + 60)
    # Steps in disparity, which move with the pan.
    wide_px = 10.0 + 6 * (np.arange(WIDTH + 60) // 12 % 2)[None].repeat(HEIGHT, 0)
    video, truths_px = [], []
    for number in range(10):
        seen = slice(6 * number, 6 * number + WIDTH)
        truths_px.append(wide_px[:, seen])
        video.append(
            (
                wide[:, seen].copy(),
                wide[:, seen].copy(),
                estimate(truths_px[-1] + rng.normal(0, 0.3, (HEIGHT, WIDTH))),
            )
        )
    found = disparities(filter_all(video)[0])
    inner = np.s_[4:, 16:-16, 16:-16]
    error_px = np.abs(found - truths_px)[inner].mean()
    assert error_px < 0.6 * np.abs(disparities([each for *_, each in video]) - truths_px)[inner].mean()


def test_a_cut_restarts_the_filter(rng):
    before = at_rest(rng, [plain(10)] * 3)
    after = at_rest(rng, [estimate(*(10 + rng.normal(0, 0.3, (2, HEIGHT, WIDTH))))])
    found = filter_all(before + after)[0]
    assert_unchanged(found[3], after[0])


def test_a_frame_of_another_size_is_a_cut(rng):
    video = at_rest(rng, [plain(10)])
    video.append((texture(rng, 90, 91), texture(rng, 90, 91), estimate(np.full((90, 91), 7.0))))
    assert_unchanged(filter_all(video)[0][1], video[1])


def plain_with_patch(rng, row, column, disparity_px):
    left, right = (np.full((HEIGHT, WIDTH, 3), 128, np.uint8) for _ in range(2))
    patch = texture(rng, 20, 20)
    left[row : row + 20, column : column + 20] = patch
    right[row : row + 20, column - disparity_px : column - disparity_px + 20] = patch
    return left, right, plain(disparity_px)


def test_a_cut_between_plain_scenes_shows_in_their_disparity(rng):
    before, after = plain_with_patch(rng, 20, 40, 10), plain_with_patch(rng, 70, 120, 30)
    found = filter_all([before] * 3 + [after] * 2)[0]
    assert (disparities(found)[3:] == 30).all()


def test_an_object_that_comes_and_goes_over_plain_ground_is_not_a_cut(rng):
    places, values_px = [(20, 40), (70, 120), (20, 100)], [10.0, 10.6, 10.0]
    video = [
        (*plain_with_patch(rng, row, column, 10)[:2], plain(10, px))
        for (row, column), px in zip(places, values_px, strict=True)
    ]
    found = disparities(filter_all(video)[0])
    np.testing.assert_allclose(found[:, *PIXEL], [10.0, 10.3, 10.2], atol=1e-5)


@pytest.mark.parametrize("contrast", [0.25, 0.1])
def test_a_cut_between_faint_scenes_is_detected(rng, contrast):
    def faint(pixel_px):
        images = [cv2.convertScaleAbs(texture(rng), alpha=contrast, beta=100) for _ in range(2)]
        return *images, plain(10, pixel_px)

    before, after = faint(10.0), faint(10.6)
    found = filter_all([before, before, after, after])[0]
    assert_unchanged(found[2], after)


@pytest.mark.parametrize("jump_px", [3, 6, -6])
def test_motion_in_only_the_right_view_is_not_outvoted(rng, jump_px):
    left, wide = texture(rng), texture(rng, HEIGHT, WIDTH + 20)
    near_px = np.array([20, 20, 20, 20 + jump_px])
    rights = [wide[:, 10 + shift_px : 10 + shift_px + WIDTH].copy() for shift_px in near_px - 20]
    video = [(left, right, plain(px)) for right, px in zip(rights, near_px, strict=True)]
    found = filter_all(video)[0]
    assert np.abs(found[-1].disparity_px - near_px[-1]).mean() < 0.1


def test_a_small_object_that_moves_only_in_the_right_view_is_not_outvoted(rng):
    ground, thing = texture(rng), texture(rng, 12, 12)
    video, square = [], np.s_[60:72, 100:112]
    for near_px in range(12, 33, 3):
        left, right = ground.copy(), ground.copy()
        column = 100 - near_px
        left[square] = right[60:72, column : column + 12] = thing
        disparity_px = np.zeros((HEIGHT, WIDTH))
        disparity_px[square] = near_px
        video.append((left, right, estimate(disparity_px)))
    found = disparities(filter_all(video)[0])
    np.testing.assert_allclose(found[:, *square].mean(axis=(1, 2)), range(12, 33, 3), atol=0.2)


@pytest.mark.parametrize(("gain", "offset_levels"), [(0.6, 0), (0.8, 50), (1.0, -20)])
def test_a_fade_is_not_a_cut_and_keeps_the_mean(rng, gain, offset_levels):
    left, right = (cv2.convertScaleAbs(texture(rng), alpha=0.6, beta=40) for _ in range(2))
    faded = [np.clip(gain * image + offset_levels, 0, 255).astype(np.uint8) for image in (left, right)]
    found = filter_all([(left, right, plain(10, 10.0)), (*faded, plain(10, 10.6))])[0]
    np.testing.assert_allclose(found[1].disparity_px[PIXEL], 10.3, atol=1e-5)


def test_a_restored_filter_continues_bit_for_bit(rng, tmp_path):
    video, _, _ = square_video(rng, 6, 3, 1)
    found, temporal_filter = filter_all(video[:3])
    np.savez(tmp_path / "state.npz", **temporal_filter.state())
    with np.load(tmp_path / "state.npz") as state:
        again = TemporalFilter.from_state(state)
    for frame in video[3:]:
        one, other = temporal_filter(*frame), again(*frame)
        for name in ("disparity_px", "right_disparity_px", "confidence", "occluded"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(
    "start", [TemporalFilter, lambda threads: TemporalFilter.from_state(TemporalFilter().state(), threads)]
)
@pytest.mark.parametrize("threads", [1, 2])
def test_no_more_threads_run_than_requested(rng, start, threads):
    workers = set()
    temporal_filter = start(threads)
    threading.setprofile(lambda *_: workers.add(threading.get_ident()))
    try:
        for frame in at_rest(rng, [plain(10)] * 2):
            temporal_filter(*frame)
    finally:
        threading.setprofile(None)
    assert len(workers) <= threads


def test_the_number_of_threads_changes_nothing(rng):
    video, _, _ = square_video(rng, 3, 3, 1)
    one, two = TemporalFilter(1), TemporalFilter(2)
    for frame in video:
        found, expected = one(*frame), two(*frame)
        np.testing.assert_array_equal(found.disparity_px, expected.disparity_px)
        np.testing.assert_array_equal(found.right_disparity_px, expected.right_disparity_px)


def test_a_filter_restored_before_the_first_frame_begins_anew(rng):
    again = TemporalFilter.from_state(TemporalFilter().state())
    assert again.last is None
    (frame,) = at_rest(rng, [plain(10)])
    assert_unchanged(again(*frame), frame)


def test_the_state_does_not_grow_with_the_video(rng):
    def state_bytes(frames):
        return sum(
            values.nbytes for values in filter_all(at_rest(rng, [plain(10)] * frames))[1].state().values()
        )

    assert state_bytes(2) == state_bytes(9)


@pytest.mark.parametrize(("height", "width"), [(33, 35), (65, 98), (48, 131)])
def test_odd_image_sizes_are_filtered(rng, height, width):
    left, right = texture(rng, height, width), texture(rng, height, width)
    maps_px = 10 + rng.normal(0, 0.2, (6, height, width))
    found = disparities(filter_all([(left, right, estimate(each)) for each in maps_px])[0])
    assert found.shape == (6, height, width)
    assert np.abs(found[-1] - 10).mean() < 0.6 * np.abs(maps_px - 10).mean()


def test_low_and_wide_frames_are_filtered(rng):
    height, width = 40, 200
    left, right = texture(rng, height, width), texture(rng, height, width)
    maps_px = 10 + rng.normal(0, 0.2, (6, height, width))
    found = disparities(filter_all([(left, right, estimate(each)) for each in maps_px])[0])
    assert np.abs(found[-1] - 10).mean() < 0.6 * np.abs(maps_px - 10).mean()


def test_an_estimate_of_another_size_is_refused(rng, without_shape_checks):
    expected = "estimate: expected the same size as both images, found .90, 91."
    with pytest.raises(StereoweaveError, match=expected):
        TemporalFilter()(texture(rng), texture(rng), estimate(np.ones((90, 91))))


def random_track(rng, shape):
    return Track(
        rng.choice([5.0, 5.4, 7.0, 30.0], shape).astype(np.float32),
        rng.uniform(0, 1, shape).astype(np.float32),
        rng.choice([0.0, 0.4, 1.3, 6.0, 11.8], shape).astype(np.float32),
        rng.uniform(-0.5, 0.5, (*shape, 2)).astype(np.float32),
        rng.choice([5.2, 7.3, 29.8], shape).astype(np.float32),
        rng.choice([0.0, 0.2, 0.9, 3.0], shape).astype(np.float32),
    )


def random_motion(rng, shape):
    half = ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
    # Exact halves are excluded, because NumPy and the kernel may round them differently.
    to_before_px = rng.integers(-5, 6, (*half, 2)) + rng.uniform(-0.4, 0.4, (*half, 2))
    explained, calm, rests = (rng.random(half) < share for share in (0.8, 0.5, 0.6))
    return Motion(to_before_px.astype(np.float32), explained, calm, 1.0, rests)


def empty_track(shape):
    return Track(*(np.full(each.shape, np.nan, np.float32) for each in begin_track(np.zeros(shape))))


def begin_track(disparity_px):
    """Return the track of a disparity map that is all that is known, with no frames."""
    nothing = np.zeros(disparity_px.shape, np.float32)
    confidence, frames, rival_px, rival_frames = nothing[None].repeat(4, 0)
    offset_px = np.zeros((*nothing.shape, 2), np.float32)
    return Track(nothing, confidence, frames, offset_px, rival_px, rival_frames)


def plain_carry(new_px, track, motion, source, source_offset_px):
    carried = begin_track(new_px)
    height, width = new_px.shape
    for y, x in np.ndindex(new_px.shape):
        half = y // 2, x // 2
        if source[y, x] >= 0 and motion.rests[half] and motion.explained[half]:
            for to, values in zip(carried, track, strict=True):
                to[y, x] = values[divmod(source[y, x], width)]
            carried.offset_px[y, x] = source_offset_px[y, x]
            continue
        column, row = (np.array([x, y]) + np.rint(motion.to_before_px[half])).astype(int)
        if not motion.explained[half] or not (0 <= row < height and 0 <= column < width):
            continue
        place = row, column
        if not motion.calm[half]:
            around = [(row + j, column + i) for j in (-1, 0, 1) for i in (-1, 0, 1)]
            around = [each for each in around if 0 <= each[0] < height and 0 <= each[1] < width]
            apart_px = [abs(track.disparity_px[each] - new_px[y, x]) for each in around]
            if min(apart_px) < abs(track.disparity_px[place] - new_px[y, x]) - 0.5:
                place = around[int(np.argmin(apart_px))]
        for to, values in zip(carried, track, strict=True):
            to[y, x] = values[place]
        carried.offset_px[y, x] = 0
    return carried


def plain_drift(new_px, carried, shape):
    drift_px = np.zeros(shape)
    offsets = STEP_PX * np.arange(-STEPS, STEPS + 1)
    for i, j in np.ndindex(shape):
        places = [(2 * i + dy, 2 * j + dx) for dy in offsets for dx in offsets]
        places = [(y, x) for y, x in places if 0 <= y < new_px.shape[0] and 0 <= x < new_px.shape[1]]
        places = [place for place in places if carried.frames[place] > 0]
        places = [place for place in places if abs(new_px[place] - new_px[2 * i, 2 * j]) < NEIGHBOUR_PX]
        changes_px = np.array([float(new_px[place]) - carried.disparity_px[place] for place in places])
        changes_px = changes_px[np.abs(changes_px) < NEIGHBOUR_PX]
        if len(changes_px) > 1:
            mean_px = changes_px.mean()
            error_px = changes_px.std(ddof=1) / np.sqrt(len(changes_px))
            if abs(mean_px) > error_px:
                drift_px[i, j] = mean_px * (1 - (error_px / mean_px) ** 2)
    return drift_px


def plain_blend(new, carried, calm, drift_px):
    mean = begin_track(new.frames)
    for at in np.ndindex(new.frames.shape):
        half = at[0] // 2, at[1] // 2
        found_px, old_confidence, count, offset_px, rival_px, rival = (values[at] for values in carried)
        found_px, rival_px = found_px + drift_px[half], rival_px + drift_px[half]
        new_px, confidence = new.disparity_px[at], new.confidence[at]
        weight, same_px = max(confidence, LEAST_WEIGHT), SAME_PX + SAME_SHARE * abs(new_px)
        if count == 0 or abs(new_px - found_px) <= same_px:
            before = count
            count = min(count + weight, MOST_FRAMES)
            share, rival = weight / count, max(rival - weight / 2, 0) if before else 0
            found_px, confidence = (
                (1 - share) * found_px + share * new_px,
                ((1 - share) * old_confidence + share * confidence),
            )
            offset_px = offset_px * (before > 0)
        elif calm[half] or weight < DOUBTED_SHARE * old_confidence:
            if rival > 0 and abs(new_px - rival_px) <= same_px:
                rival_px, rival = (rival * rival_px + weight * new_px) / (rival + weight), rival + weight
            else:
                rival_px, rival = (rival_px, rival - weight) if rival > weight else (new_px, weight)
            if rival > max(count, LEAST_RIVAL):
                found_px, count, rival_px, rival, offset_px = rival_px, rival, found_px, count, 0
            else:
                confidence = old_confidence * count / (count + weight)
        else:
            found_px, count, rival, offset_px = new_px, weight, 0, 0
        for to, value in zip(mean, (found_px, confidence, count, offset_px, rival_px, rival), strict=True):
            to[at] = value
    return mean


@pytest.mark.parametrize("shape", [(40, 50), (41, 33)])
def test_the_kernels_equal_their_plain_versions(rng, shape):
    track, new, motion = random_track(rng, shape), random_track(rng, shape), random_motion(rng, shape)
    carried = empty_track(shape)
    source = rng.integers(-1, shape[0] * shape[1], shape).astype(np.int32)
    source_offset_px = rng.uniform(-0.5, 0.5, (*shape, 2)).astype(np.float32)
    carry(new.disparity_px, track, motion, source, source_offset_px, carried)
    plain_carried = plain_carry(new.disparity_px, track, motion, source, source_offset_px)
    for found, expected in zip(carried, plain_carried, strict=True):
        np.testing.assert_array_equal(found, expected)
    drift_px = np.full(motion.calm.shape, np.nan, np.float32)
    measure_drift(new.disparity_px, carried, drift_px)
    np.testing.assert_allclose(drift_px, plain_drift(new.disparity_px, carried, drift_px.shape), atol=1e-5)
    mean = empty_track(shape)
    blend(new, carried, motion.calm, drift_px, mean)
    for found, expected in zip(mean, plain_blend(new, carried, motion.calm, drift_px), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)
