"""Survey of a video before its conversion: disparities and defects of frames from the whole video."""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import groupby, islice
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from rich.progress import Progress

from stereoweave.cameras.alignment import RECTIFY, SWAPPED, check_pair
from stereoweave.cameras.auto_align import SWAPPED_BACK, Aligned, align
from stereoweave.cameras.diagnosis import CALIBRATE, CALIBRATE_AGAIN, find_problems
from stereoweave.errors import Note, Remedy
from stereoweave.io.colormap import find_colour_range_px
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.rendering.layouts import median_disparity_px
from stereoweave.rendering.scaling import fit_size
from stereoweave.stereo import StereoCamera, StereoPair
from stereoweave.system.threads import thread_count
from stereoweave.video.packings import find_swapped_packing
from stereoweave.video.reader import StereoFrame, StereoVideo
from stereoweave.video.times import format_frame_time

_SURVEYED_FRAMES, _CHECKED_FRAMES = 24, 3
# Unchecked frames are matched at this width, where a range of disparities is found as well.
_SURVEYED_WIDTH_PX = 320
_SURVEY_STEP_PX = 4
_NAMED_SPANS = 3
# The percentiles exclude outliers. The margin allows for objects that come nearer between surveyed frames.
_OUTER_PERCENT, _MARGIN_PX = 0.5, 8.0


class Survey(NamedTuple):
    """Disparity statistics of frames spread over the whole video.

    Attributes:
        range_px: Disparity range that the colours represent.
        middle_px: Median disparity of the scene.
        match_range_px: Disparity range to match; None if the network's own range covers the surveyed frames.
        swapped: Whether left and right are swapped in most of the surveyed frames.
    """

    range_px: tuple[float, float]
    middle_px: float
    match_range_px: tuple[float, float] | None
    swapped: bool = False


class _Sample(NamedTuple):
    """What a frame shows.

    Attributes:
        time: Time of the frame in seconds.
        disparities_px: Disparities of a grid of pixels [N, 1].
        middle_px: Median disparity.
        swapped: Whether left and right are swapped.
        flat: Whether both views are the same picture.
        notes: Notes on the frame; None if it was not checked for problems.
    """

    time: Fraction
    disparities_px: np.ndarray
    middle_px: float
    swapped: bool
    flat: bool
    notes: list[Note] | None


def survey_video(
    video: StereoVideo, matcher: Matcher, bar: Progress, *, rectified: bool = True, threads: int | None = None
) -> tuple[Survey, list[Note]]:
    """Measure the disparities of frames spread over the whole video; return them, and notes on the video.

    The first frames alone are not enough, because they may be titles with a different disparity range. If
    `rectified`, frames out of line are aligned first. Up to `threads` frames are measured at once.
    """
    picked = _spread_evenly(video.frame_count, _SURVEYED_FRAMES)
    checked = set(picked[len(picked) // 6 :: -(-len(picked) // _CHECKED_FRAMES)])
    shown = bar.add_task("surveying depth", total=len(picked), loss="", rate="")
    samples = []
    for sample in _sample_frames(video, matcher, (picked, checked), rectified=rectified, threads=threads):
        samples.append(sample)
        bar.advance(shown)
    remedy = _choose_remedy(video, rectified=rectified)
    defects = [
        [_fit_remedy(note, video, remedy) for note in sample.notes]
        for sample in samples
        if sample.notes is not None
    ]
    all_px = np.vstack([sample.disparities_px for sample in samples])
    survey = Survey(
        find_colour_range_px(all_px),
        float(np.median([sample.middle_px for sample in samples])),
        _find_match_range_px(all_px, matcher),
        2 * sum(sample.swapped for sample in samples) > len(samples),
    )
    swapped = [SWAPPED_BACK] if survey.swapped else []
    return survey, [*video.notes, *_note_flat(samples), *swapped, *_select_common_notes(defects)]


def _sample_frames(
    video: StereoVideo,
    matcher: Matcher,
    chosen: tuple[range, set[int]],
    *,
    rectified: bool,
    threads: int | None,
) -> Iterator[_Sample]:
    """Yield samples of the chosen frames; those in the second set are checked for problems."""
    picked, checked = chosen
    count = thread_count(threads)
    frames = islice(video.frames(), picked.start, picked.stop, picked.step)
    with ThreadPoolExecutor(count) as pool:
        coming = deque[Future[_Sample]]()
        try:
            for index, frame in zip(picked, frames, strict=True):
                # Frames wait in memory until they are measured, so only some are read ahead.
                if len(coming) > count:
                    yield coming.popleft().result()
                work = partial(
                    _sample_frame,
                    rectified=rectified,
                    checked=index in checked,
                    camera=video.camera if video.rig else None,
                )
                coming.append(pool.submit(work, frame, matcher))
            while coming:
                yield coming.popleft().result()
        finally:
            for future in coming:
                future.cancel()


def _sample_frame(
    frame: StereoFrame,
    matcher: Matcher,
    *,
    rectified: bool,
    checked: bool,
    camera: StereoCamera | None = None,
) -> _Sample:
    """Measure a frame; unless it is `checked` for problems, as its camera is too, at a smaller size."""
    pair, scale = StereoPair(left=frame.left, right=frame.right), 1.0
    if not checked:
        pair, scale = scale_down(pair)
    aligned = align(pair) if rectified else Aligned(pair=pair, alignment=check_pair(pair.left, pair.right))
    if scale > 1 and _is_flat(aligned):
        # At its own size, a shallow frame may differ from a flat one.
        return _sample_frame(frame, matcher, rectified=rectified, checked=True)._replace(notes=None)
    estimate = match(matcher, aligned.pair)
    step = max(1, round(_SURVEY_STEP_PX / scale))
    sample = _Sample(
        frame.time,
        scale * estimate.disparity_px[::step, ::step].reshape(-1, 1),
        scale * median_disparity_px(estimate),
        aligned.swapped,
        _is_flat(aligned),
        # The survey decides for the whole video whether it is swapped.
        [note for note in aligned.notes if note != SWAPPED_BACK] if checked else None,
    )
    if sample.notes is not None and not sample.flat:
        seen_by = replace(aligned.pair, camera=camera)
        sample.notes.extend(find_problems(seen_by, estimate, aligned.alignment))
    return sample


def _is_flat(aligned: Aligned) -> bool:
    """Return whether both views of a frame are the same picture."""
    return "same_picture" in aligned.alignment.defects


def scale_down(pair: StereoPair) -> tuple[StereoPair, float]:
    """Return the pair at a size that is soon matched, and its width divided by the new one."""
    height, width = pair.left.shape[:2]
    scale = width / fit_size(pair.left.shape, (_SURVEYED_WIDTH_PX, height))[0]
    size = round(width / scale), max(round(height / scale), SMALLEST_SIDE_PX)
    left, right = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (pair.left, pair.right))
    return StereoPair(left=left, right=right), scale


def _note_flat(samples: Sequence[_Sample]) -> list[Note]:
    """Return a list with a note on the flat frames, if there are any."""
    spans = []
    for is_flat, run in groupby(samples, key=lambda sample: sample.flat):
        times = [format_frame_time(sample.time) for sample in run]
        if is_flat:
            spans.append(times[0] if len(times) == 1 else f"{times[0]} to {times[-1]}")
    if not spans:
        return []
    named = ", ".join([*spans[:_NAMED_SPANS], *(["..."] if len(spans) > _NAMED_SPANS else [])])
    return [Note(f"{named} flat: both views are the same picture, so no depth can be seen")]


def _find_match_range_px(
    disparity_px: Float[np.ndarray, "n 1"], matcher: Matcher
) -> tuple[float, float] | None:
    """Return the disparity range to match; None if the network's own range covers all disparities."""
    low_px, high_px = np.percentile(disparity_px, [_OUTER_PERCENT, 100 - _OUTER_PERCENT]).tolist()
    if low_px >= 0 and high_px <= matcher.max_disparity_px:
        return None
    # A plain sky is matched at the lower end of the range, which stays at 0 for parallel cameras.
    return min(low_px, max(low_px - _MARGIN_PX, 0.0)), high_px + _MARGIN_PX


def _spread_evenly(count: int, wanted: int) -> range:
    """Return the indices of at most `wanted` frames, spread evenly over `count` frames."""
    step = -(-count // wanted)
    return range(step // 2, count, step)


def _choose_remedy(video: StereoVideo, *, rectified: bool) -> Remedy | None:
    """Return what to do if rows are apart."""
    if video.rig:
        return CALIBRATE_AGAIN
    if not rectified:
        return RECTIFY
    return None if video.sphere else CALIBRATE


def _fit_remedy(note: Note, video: StereoVideo, remedy: Remedy | None) -> Note:
    """Return a note on a frame with a remedy for the video.

    It is `remedy` if rows are apart, and the other frame packing if the views in a single file are swapped.
    """
    if note.remedy == RECTIFY:
        return replace(note, remedy=remedy)
    other = find_swapped_packing(video.frame_packing)
    if note == SWAPPED and other:
        return replace(note, remedy=Remedy(f"choose {other}", ("format",)))
    return note


def _select_common_notes(defects: Sequence[list[Note]]) -> list[Note]:
    """Return the notes on the last frame with notes if over half of the frames have notes; otherwise none.

    They name no time, because they are about more than that frame: the time of one would read as if the
    frames before it were sound. Notes on fewer frames are unreliable, because a video may begin with black
    frames.
    """
    some = [notes for notes in defects if notes]
    if 2 * len(some) <= len(defects):
        return []
    where = "" if len(some) == len(defects) else "in most of the video: "
    return [replace(note, text=where + note.text) for note in some[-1]]
