"""Disparity that holds still from frame to frame of a film: filtered along its motion, anew after each cut.

Each view is filtered by itself. What was found before is brought along the motion of the picture, and what a
surface's neighbourhood then says in common is taken for a true change of its distance. What is left is noise:
a pixel becomes the mean over the frames that saw its point. It starts anew where the picture before does not
explain it, and where the disparity contradicts what was found: at once beside anything that moves in either
view, by vote where all is at rest. So nothing trails behind what moves.
"""

import typing
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate
from stereoweave.system.jit import kernel
from stereoweave.system.threads import thread_count

MOST_FRAMES = 12.0
"""A mean stands for no more frames than this, so that what changes slowly is not held back for long."""
SAME_PX, SAME_SHARE = 1.0, 0.02
"""Two frames see one surface where their disparities differ by no more than this, and this share of it."""
NEIGHBOUR_PX = 3.0
"""Pixels around that differ by less than this in disparity tell of the same surface's change."""
STEP_PX, STEPS = 8, 2
"""Those that are asked lie on a grid of this step, so many to each side."""

# Of half the size, where noise is half as strong, and motion takes a quarter of the time.
_WINDOW_PX = 5
# A window is explained if its mean difference is below this multiple of what is usual in the picture, which
# is its noise; something is added for clean pictures, and more than so much is no noise.
_UNUSUAL, _LEAST_LEVELS, _NOISIEST_LEVELS = 1.5, 0.5, 6.0
# Motion always explains a little more than rest, for it also fits the noise.
_REST, _REST_LEVELS = 1.1, 0.25
# At rest is what has nothing that moves within half of this.
_CALM_PX = 9
# What a plane has none of; normal noise of one level makes it 6 levels, half of it below 0.674 times that.
_ROUGHNESS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_MEDIAN_ROUGHNESS = 6 * 0.674
# Contrast is a standard deviation above this multiple of the noise's, and a level.
_CONTRAST, _CONTRAST_LEVELS = 2.0, 1.0
# What differs by more than this share of its contrast is something else, however faint both are.
_DIFFERENT_SHARE = 0.6
# Rendered films explain more than 0.4 of their contrast from the frame before; pairs of scenes less than 0.1.
_CUT_SHARE = 0.2
# Contrast in less than this share of a picture is a thing in it, which may come and go without a cut.
_LEAST_CONTRAST_SHARE = 0.05
# Where so much of the picture is at rest, most of it is not contradicted by chance.
_LEAST_ASKED_SHARE = 0.25


class Track(typing.NamedTuple):
    """What is known about one view; arrays are float32 [H, W].

    Attributes:
        disparity_px: The mean of what the frames said.
        confidence: The mean of what they claimed, 0 where one said otherwise.
        frames: How many stand behind the mean, less those that contradicted it since; 0 for none.
    """

    disparity_px: np.ndarray
    confidence: np.ndarray
    frames: np.ndarray


class Motion(typing.NamedTuple):
    """How a picture follows from the one before; arrays are of half its size, rounded up.

    Attributes:
        to_before_px: float32 [H2, W2, 2], from a pixel to its point in the picture before, full-size pixels.
        explained: bool, whether the picture before looks the same there.
        calm: bool, whether nothing moves around.
        explained_share: Of what has contrast; 1 where next to nothing has.
    """

    to_before_px: np.ndarray
    explained: np.ndarray
    calm: np.ndarray
    explained_share: float


class Expectation(typing.NamedTuple):
    """What a view is to show, from what was found before; the last two arrays are of half its size.

    Attributes:
        carried: What is known about the point that each pixel shows now.
        calm: bool, whether nothing moves around, nor around the place it matches in the other view.
        drift_px: float32, how the surface changes in disparity.
    """

    carried: Track
    calm: np.ndarray
    drift_px: np.ndarray


class Steadier:
    """Takes the estimates of a film, frame by frame, and gives each filtered with those before it.

    Args:
        threads: How many may be used, of which two views need two; all cores if left out.

    Attributes:
        cuts: How many cuts there were so far.

    Raises:
        StereoweaveError: `threads` is below 1.
    """

    def __init__(self, threads: int | None = None) -> None:
        self.cuts = 0
        self._threads = min(thread_count(threads), 2)
        self._greys: list[np.ndarray] = []
        self._tracks: list[Track] = []

    def __call__(
        self, left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], estimate: Estimate
    ) -> Estimate:
        """The estimate of this frame, filtered along the motion of both pictures; itself after a cut.

        Args:
            left: The frame's left picture, uint8 RGB [H, W, 3].
            right: The right one, of the same size.
            estimate: Of these two.

        Returns:
            Both disparities and the confidence are filtered; `occluded` is the frame's own.
        """
        if left.shape != right.shape or left.shape[:2] != estimate.disparity_px.shape:
            raise StereoweaveError(
                f"estimate: expected the size of both pictures, got {list(estimate.disparity_px.shape)} for "
                f"{list(left.shape[:2])} and {list(right.shape[:2])}; estimate these two"
            )
        before, self._greys = self._greys, [_grey(left), _grey(right)]
        # The right view makes no claim; what stands for it is not given out.
        claims = (estimate.confidence, np.ones_like(estimate.confidence))
        disparities_px = (estimate.disparity_px, estimate.right_disparity_px)
        news = [Track(*maps, np.ones_like(maps[0])) for maps in zip(disparities_px, claims, strict=True)]
        continued = self._continued(before, news) if before else None
        if before and continued is None:
            self.cuts += 1
        self._tracks = continued or news
        filtered, filtered_right = self._tracks
        return Estimate(
            disparity_px=filtered.disparity_px,
            right_disparity_px=filtered_right.disparity_px,
            confidence=filtered.confidence,
            occluded=estimate.occluded,
        )

    def state(self) -> dict[str, np.ndarray]:
        """All that is needed to go on exactly, as arrays that `np.savez` keeps."""
        kept = {"cuts": np.array(self.cuts)}
        for side, grey, track in zip(("left", "right"), self._greys, self._tracks, strict=False):
            kept[f"{side}_grey"] = grey
            kept |= {f"{side}_{name}": values for name, values in track._asdict().items()}
        return kept

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray], threads: int | None = None) -> "Steadier":
        """One that goes on where the one that gave this `state` was."""
        steadier = cls(threads)
        steadier.cuts = int(state["cuts"])
        for side in ("left", "right") if "left_grey" in state else ():
            steadier._greys.append(state[f"{side}_grey"])
            steadier._tracks.append(Track(*(state[f"{side}_{name}"] for name in Track._fields)))
        return steadier

    def _continued(self, before: list[np.ndarray], news: list[Track]) -> list[Track] | None:
        """The tracks filtered with those before; None after a cut."""
        if news[0].frames.shape != self._tracks[0].frames.shape:
            return None
        with ThreadPoolExecutor(self._threads) as pool:
            motions = list(pool.map(_motion, before, self._greys))
            if np.mean([motion.explained_share for motion in motions]) < _CUT_SHARE:
                return None
            # A match lies to the left in the right view, and to the right in the left one.
            expected = list(pool.map(_expected, self._tracks, news, motions, motions[::-1], (-1, 1)))
            if _mostly_contradicted(news, expected):
                return None
            return list(pool.map(_filtered, news, expected))


def _grey(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
    """Grey levels at half the size, rounded up."""
    height, width = image.shape[:2]
    half = ((width + 1) // 2, (height + 1) // 2)
    return cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), half, interpolation=cv2.INTER_AREA)


def _motion(before: UInt8[np.ndarray, "h2 w2"], grey: UInt8[np.ndarray, "h2 w2"]) -> Motion:
    """How a picture follows from the one before; both are of half the size."""
    before = _as_bright(before, grey)
    rest = np.zeros((*grey.shape, 2), np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST).calc(grey, before, rest)
    moved_levels = _difference_levels(grey, _warped(before, flow))
    rest_levels = _difference_levels(grey, before)
    least_levels = np.minimum(moved_levels, rest_levels)
    usual_levels = min(float(np.median(least_levels[::4, ::4])), _NOISIEST_LEVELS)
    explained = least_levels <= _UNUSUAL * usual_levels + _LEAST_LEVELS
    rests = rest_levels <= _REST * moved_levels + _REST_LEVELS
    flow[rests] = 0
    around = np.ones((_CALM_PX, _CALM_PX), np.uint8)
    calm = cv2.erode((rests & explained).astype(np.uint8), around).astype(bool)
    return Motion(2 * flow, explained, calm, _explained_share(grey, least_levels, explained))


def _explained_share(
    grey: UInt8[np.ndarray, "h2 w2"],
    least_levels: Float[np.ndarray, "h2 w2"],
    explained: Bool[np.ndarray, "h2 w2"],
) -> float:
    """The share explained of what has contrast; 1 where next to nothing has."""
    window = (_WINDOW_PX, _WINDOW_PX)
    squares = cv2.sqrBoxFilter(grey, cv2.CV_32F, window)
    variance = squares - cv2.boxFilter(grey, cv2.CV_32F, window) ** 2
    contrast_levels = np.sqrt(np.maximum(variance, 0))
    has_contrast = contrast_levels > _CONTRAST * _noise_levels(grey) + _CONTRAST_LEVELS
    if has_contrast.mean() < _LEAST_CONTRAST_SHARE:
        return 1.0
    alike = explained & (least_levels < _DIFFERENT_SHARE * contrast_levels)
    return float(alike[has_contrast].mean())


def _noise_levels(grey: UInt8[np.ndarray, "h2 w2"]) -> float:
    """The noise's standard deviation, from the median size of what a smooth picture has none of."""
    roughness = cv2.filter2D(grey, cv2.CV_32F, _ROUGHNESS)
    return float(np.median(np.abs(roughness[::4, ::4]))) / _MEDIAN_ROUGHNESS


def _as_bright(
    before: UInt8[np.ndarray, "h2 w2"], grey: UInt8[np.ndarray, "h2 w2"]
) -> UInt8[np.ndarray, "h2 w2"]:
    """The picture before with the mean and the contrast of this one, so that a fade is no change."""
    (old_mean, old_contrast), (mean, contrast) = (
        [float(value[0, 0]) for value in cv2.meanStdDev(picture)] for picture in (before, grey)
    )
    gain = contrast / max(old_contrast, 1.0)
    return cv2.addWeighted(before, gain, before, 0, mean - gain * old_mean)


def _warped(
    before: UInt8[np.ndarray, "h2 w2"], flow: Float[np.ndarray, "h2 w2 2"]
) -> UInt8[np.ndarray, "h2 w2"]:
    height, width = before.shape
    rows, columns = np.indices((height, width), np.float32)
    source = flow[..., 0] + columns, flow[..., 1] + rows
    return cv2.remap(before, *source, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _difference_levels(
    a: UInt8[np.ndarray, "h2 w2"], b: UInt8[np.ndarray, "h2 w2"]
) -> Float[np.ndarray, "h2 w2"]:
    """The mean absolute difference over a window around each pixel."""
    return cv2.boxFilter(cv2.absdiff(a, b), cv2.CV_32F, (_WINDOW_PX, _WINDOW_PX))


def _expected(track: Track, new: Track, motion: Motion, other: Motion, towards: int) -> Expectation:
    """What the new frame is to show; a match lies towards (-1 left, 1 right) its place in the other view."""
    carried = Track(*(np.empty_like(values) for values in track))
    carry(new.disparity_px, track, motion, carried)
    drift_px = np.empty(motion.calm.shape, np.float32)
    measure_drift(new.disparity_px, carried, drift_px)
    calm = motion.calm & _matched(other.calm, carried.disparity_px[::2, ::2], towards)
    return Expectation(carried, calm, drift_px)


def _matched(
    other_calm: Bool[np.ndarray, "h2 w2"], disparity_px: Float[np.ndarray, "h2 w2"], towards: int
) -> Bool[np.ndarray, "h2 w2"]:
    """Whether the other view is calm where each pixel has its match; at its edge for one outside it."""
    height, width = other_calm.shape
    rows, columns = np.indices((height, width), np.float32)
    there = columns + np.float32(towards / 2) * disparity_px
    calm = other_calm.astype(np.uint8)
    return cv2.remap(calm, there, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0


def _mostly_contradicted(news: list[Track], expected: list[Expectation]) -> bool:
    """Whether most of what is known and at rest has another disparity now, by every fourth pixel."""
    asked, contradicted = [], []
    for new, (carried, calm, drift_px) in zip(news, expected, strict=True):
        new_px, old_px, frames = (
            values[::4, ::4] for values in (new.disparity_px, carried.disparity_px, carried.frames)
        )
        apart_px = np.abs(new_px - old_px - drift_px[::2, ::2])
        asked.append(calm[::2, ::2] & (frames > 0))
        contradicted.append(asked[-1] & (apart_px > SAME_PX + SAME_SHARE * np.abs(new_px)))
    asked_share = np.mean(asked)
    return bool(asked_share >= _LEAST_ASKED_SHARE and np.mean(contradicted) > 0.5 * asked_share)


def _filtered(new: Track, expected: Expectation) -> Track:
    """The track as it is after a further frame."""
    mean = Track(*(np.empty_like(values) for values in new))
    blend(new, expected.carried, expected.calm, expected.drift_px, mean)
    return mean


@kernel
@typing.no_type_check
def carry(new_px, track, motion, carried):
    """Write into carried what track knows about the point that each pixel shows now; 0 frames for nothing.

    Motion is not exact to the pixel: where not all is calm, one of the nine pixels around the place before is
    taken that has the surface which new_px [H, W] has now, if there is one.
    """
    old_px, old_confidence, old_frames = track.disparity_px, track.confidence, track.frames
    disparity_px, confidence, frames = carried.disparity_px, carried.confidence, carried.frames
    to_before_px, explained, calm = motion.to_before_px, motion.explained, motion.calm
    height, width = new_px.shape
    for y in range(height):
        for x in range(width):
            i, j = y // 2, x // 2
            disparity_px[y, x] = confidence[y, x] = frames[y, x] = 0.0
            row = int(round(y + to_before_px[i, j, 1]))
            column = int(round(x + to_before_px[i, j, 0]))
            if not explained[i, j] or row < 0 or row >= height or column < 0 or column >= width:
                continue
            if not calm[i, j]:
                middle_row, middle_column = row, column
                # The middle one has to be clearly worse, so that noise does not shift the map to and fro.
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


@kernel
@typing.no_type_check
def measure_drift(new_px, carried, drift_px):
    """Write into drift_px [H2, W2] how the surface around every second pixel changes in disparity.

    That is the mean change there, as far as it is more than chance: James and Stein's estimate, which takes
    the square of the standard error off that of the mean, and gives 0 where less than nothing is left.
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
    """Write into mean what is known after the new frame."""
    new_px, new_confidence = new.disparity_px, new.confidence
    old_px, old_confidence, old_frames = carried.disparity_px, carried.confidence, carried.frames
    disparity_px, confidence, frames = mean.disparity_px, mean.confidence, mean.frames
    height, width = new_px.shape
    for y in range(height):
        for x in range(width):
            expected_px = old_px[y, x] + drift_px[y // 2, x // 2]
            apart_px = new_px[y, x] - expected_px
            count = old_frames[y, x]
            if count > 0 and abs(apart_px) > SAME_PX + SAME_SHARE * abs(new_px[y, x]):
                if calm[y // 2, x // 2]:
                    disparity_px[y, x] = expected_px
                    confidence[y, x] = old_confidence[y, x] * count / (count + 1.0)
                    frames[y, x] = count - 1.0
                    continue
                count = 0.0
            count = min(count + 1.0, MOST_FRAMES)
            share = 1.0 / count
            disparity_px[y, x] = new_px[y, x] - (1.0 - share) * apart_px
            confidence[y, x] = old_confidence[y, x] + share * (new_confidence[y, x] - old_confidence[y, x])
            frames[y, x] = count
