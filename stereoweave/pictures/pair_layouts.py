"""Layouts of two views in one picture or video frame, and detection of the layout."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Num, UInt8

from stereoweave.errors import FormatError, Note, Remedy
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.pictures.anaglyphs import looks_like_anaglyph
from stereoweave.pictures.interleaved import (
    INTERLEAVED_LAYOUTS,
    InterleavedLayout,
    suspect_interleaving,
)

Picture = UInt8[np.ndarray, "h w 3"]
Frame = UInt8[np.ndarray, "rows columns 3"]


class PairLayout(NamedTuple):
    """Layout of two views in one frame; by default side by side at full size, with the left view first."""

    beside: bool = True
    half: bool = False
    right_first: bool = False

    def swapped(self) -> "PairLayout":
        """Return the layout with the other view first."""
        return self._replace(right_first=not self.right_first)

    def eye_size_px(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Return the width and height of one view at full size.

        Raises:
            FormatError: The halves of the frame are too small.
        """
        side, extent_px = ("width", width_px) if self.beside else ("height", height_px)
        if extent_px < 2 * SMALLEST_SIDE_PX:
            raise FormatError(
                f"expected a {side} of at least {2 * SMALLEST_SIDE_PX} pixels for two views, "
                f"found {width_px}x{height_px}; give a larger picture"
            )
        if self.half:
            even_px = extent_px // 2 * 2
            return (even_px, height_px) if self.beside else (width_px, even_px)
        return (width_px // 2, height_px) if self.beside else (width_px, height_px // 2)

    def eyes(
        self, frame: Num[np.ndarray, "rows columns 3"]
    ) -> tuple[Num[np.ndarray, "h w 3"], Num[np.ndarray, "h w 3"]]:
        """Return the left and the right view of a frame, each at full size.

        Of a frame of odd width (or height), the last column (or row) is dropped.
        """
        height_px, width_px = frame.shape[:2]
        frame = frame[:, : width_px // 2 * 2] if self.beside else frame[: height_px // 2 * 2]
        first, second = np.split(frame, 2, axis=1 if self.beside else 0)
        if self.half:
            size_px = frame.shape[1], frame.shape[0]
            first, second = (
                cv2.resize(eye, size_px, interpolation=cv2.INTER_CUBIC) for eye in (first, second)
            )
        left, right = (second, first) if self.right_first else (first, second)
        return np.ascontiguousarray(left), np.ascontiguousarray(right)

    def note_odd_size(self, width_px: int, height_px: int) -> list[Note]:
        """Return a note on the column or row that `eyes` drops from frames of this size, if it drops one."""
        line, size, extent_px = ("column", "width", width_px) if self.beside else ("row", "height", height_px)
        if extent_px % 2 == 0:
            return []
        return [Note(f"the last {line} is dropped, because the {size}, {extent_px} px, is odd")]


_HALVES = {
    "side_by_side": PairLayout(),
    "side_by_side_half": PairLayout(half=True),
    "top_bottom": PairLayout(beside=False),
    "top_bottom_half": PairLayout(beside=False, half=True),
    "crossed": PairLayout(right_first=True),
    "crossed_half": PairLayout(half=True, right_first=True),
    "top_bottom_right_first": PairLayout(beside=False, right_first=True),
    "top_bottom_right_first_half": PairLayout(beside=False, half=True, right_first=True),
}
PAIR_LAYOUTS: dict[str, PairLayout | InterleavedLayout] = {**_HALVES, **INTERLEAVED_LAYOUTS}

_WORDS_IN_NAMES = {
    "side_by_side": {"lr", "lrf", "sbs", "hsbs", "fsbs", "halfsbs", "fullsbs", "parallel"},
    "top_bottom": {"tb", "tbf", "tab", "ou", "htb", "htab", "hou", "halfou", "fulltb", "fullou"},
    "crossed": {"rl", "rlf", "cross", "crossed", "crosseye", "crosseyed"},
}
_HALF = {"half", "hsbs", "halfsbs", "htb", "htab", "hou", "halfou"}
_FULL = {"full", "lrf", "rlf", "tbf", "fsbs", "fullsbs", "fulltb", "fullou"}

# Aspect ratios of one view. Screens and cameras have 4:3 to 2.4:1; views outside this range are half size. An
# upright video, 9:16, cannot be distinguished from a half-size view by its aspect ratio and is taken for one.
_NARROWEST_EYE, _WIDEST_EYE = 1.2, 2.5
# Photographs are upright, square or wide. If the aspect ratio fits both full and half size, the ratio of
# horizontal to vertical contrast between neighbouring pixels decides. Its median over painted pictures is
# 0.96 for full views, 1.58 for half width and 0.57 for half height.
_UPRIGHT_EYE, _LOW_EYE, _LOWEST_EYE, _SQUEEZED_CONTRAST = 0.525, 2.0, 3.0, 1.25
# Nearly square pictures more often hold half-width views than views as tall as these, unless they are 9:16.
_TALL_EYE, _SQUEEZED_CONTRAST_OF_TALL, _PHONE = 0.6, 1.0, 9 / 16
_SCREEN, _SCREEN_TOLERANCE = 16 / 9, 0.01
_DETAIL_PX = 480
# Limits of a whole frame's aspect ratio. Two upright phone pictures side by side have at least the first; two
# half-height views of the widest film, one above the other, have at most the last. A photograph between the
# first two holds half-width views of an upright or square photograph.
_NARROWEST_BESIDE, _NARROWEST_HALVES, _WIDEST_ABOVE = 1.05, 0.74, 2.45

# The resemblance is 0.34 or more for 95 % of painted or rendered pairs, many of which have far larger
# disparities than 3-D videos. It is at most 0.13 for the two halves of a single picture, and at most 0.23 if
# the picture is a blurred enlargement.
_ALIKE = 0.3
_SMALL_PX = 160, 120
_WINDOW_PX, _STEP_PX, _SHIFT_PX, _OFF_PX = 20, 10, 32, 2
_PLAIN, _FEW_WINDOWS, _AGREE_PX = 3.0, 6, 3


def detect_layout(
    name: str,
    frames: Sequence[Frame],
    declared: str | None = None,
    *,
    photograph: bool = False,
) -> str:
    """Detect a video's layout, a name in `PAIR_LAYOUTS`, from its container, its name or its frames.

    Because "LR" has other meanings too, the frames must confirm a layout found in the name, unless they are
    too plain. The frames do not show which view comes first; the left view is taken to be first, unless the
    container or the name says otherwise.

    Args:
        name: Path of the file, whose name may contain a layout, such as film_SBS or film-half-OU.
        frames: Some frames of the video, far apart in time.
        declared: Layout that the container declares, a name in `PAIR_LAYOUTS` for views at full size, which
            may nevertheless be half size, or for interleaved views.
        photograph: Whether the file is a still picture, not a video; its views may be in portrait format.

    Raises:
        FormatError: The halves of the frames do not resemble each other, side by side or one above the other;
            or the declared layout is not in `PAIR_LAYOUTS`.
    """
    if declared not in (None, *PAIR_LAYOUTS):
        raise FormatError(
            f"{name}: expected two views side by side, or the left one above the right one, found a video "
            f"that declares {declared}",
            remedy=Remedy("if that is wrong, choose its layout, such as side_by_side", ("format",)),
        )
    if declared in INTERLEAVED_LAYOUTS:
        return str(declared)
    words = set(re.split(r"[^a-z0-9]+", Path(name).name.lower()))
    named = next((kind for kind, marks in _WORDS_IN_NAMES.items() if marks & words), None)
    kind = declared or _confirm(named, frames) or _detect_by_content(name, frames, photograph)
    looks_squeezed = _looks_squeezed_photograph if photograph else _looks_squeezed
    squeezed = bool(words & _HALF) or (not words & _FULL and looks_squeezed(kind, frames[0]))
    return f"{kind}_half" if squeezed else kind


def measure_resemblance(first: Picture, second: Picture) -> float:
    """Return a score from 0 to 1 for whether two images show the same scene; NaN if they are too plain.

    Windows of the first image are matched in the second one, up to a fifth of the width away. The score is
    the median of their best correlations, times the share of neighbouring windows with similar shifts,
    because repeated patterns also correlate, but with scattered shifts. Both images are first resized to the
    same small size and high-pass filtered, because skies and floors look alike everywhere.
    """
    here, there = _extract_detail(first), _extract_detail(second)
    rows = range(_OFF_PX, _SMALL_PX[1] - _WINDOW_PX - _OFF_PX + 1, _STEP_PX)
    columns = range(0, _SMALL_PX[0] - _WINDOW_PX + 1, _STEP_PX)
    found = np.array([[_match_window(here, there, top, left) for left in columns] for top in rows])
    correlation, shift_px = found[..., 0], found[..., 1]
    steps_px = np.concatenate([np.diff(shift_px, axis=axis).ravel() for axis in (0, 1)])
    steps_px = np.abs(steps_px[~np.isnan(steps_px)])
    if np.isfinite(correlation).sum() < _FEW_WINDOWS or not steps_px.size:
        return np.nan
    return float(max(np.nanmedian(correlation), 0) * np.mean(steps_px <= _AGREE_PX))


def _match_window(
    here: Float32[np.ndarray, "h w"], there: Float32[np.ndarray, "h w"], top: int, left: int
) -> tuple[float, float]:
    """Return a window's best correlation and its shift in pixels; both are NaN for a plain window."""
    window = here[top : top + _WINDOW_PX, left : left + _WINDOW_PX]
    if window.std() < _PLAIN:
        return np.nan, np.nan
    start = max(left - _SHIFT_PX, 0)
    strip = there[top - _OFF_PX : top + _WINDOW_PX + _OFF_PX, start : left + _WINDOW_PX + _SHIFT_PX]
    _, best, _, (column, _) = cv2.minMaxLoc(cv2.matchTemplate(strip, window, cv2.TM_CCOEFF_NORMED))
    return best, start + column - left


def _extract_detail(picture: Picture) -> Float32[np.ndarray, "120 160"]:
    grey = cv2.cvtColor(cv2.resize(picture, _SMALL_PX, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    shades = grey.astype(np.float32)
    return shades - cv2.GaussianBlur(shades, (0, 0), _WINDOW_PX / 5)


def show_same_scene(pairs: Sequence[tuple[Picture, Picture]]) -> bool:
    """Return whether both pictures of most pairs show the same scene, or all are too plain to tell."""
    return not _score_pairs(pairs) < _ALIKE


def _score_halves(kind: str, frames: Sequence[Frame]) -> float:
    return _score_pairs([_split_halves(kind, frame) for frame in frames])


def _score_pairs(pairs: Sequence[tuple[Picture, Picture]]) -> float:
    """Return the median resemblance of the pairs; NaN if all are too plain."""
    scores = [measure_resemblance(*pair) for pair in pairs]
    known = [score for score in scores if not np.isnan(score)]
    return float(np.median(known)) if known else np.nan


def _split_halves(kind: str, frame: Frame) -> tuple[Picture, Picture]:
    height_px, width_px = frame.shape[0] // 2, frame.shape[1] // 2
    if _HALVES[kind].beside:
        return frame[:, :width_px], frame[:, -width_px:]
    return frame[:height_px], frame[-height_px:]


def _confirm(named: str | None, frames: Sequence[Frame]) -> str | None:
    return None if named is None or _score_halves(named, frames) < _ALIKE else named


def _detect_by_content(name: str, frames: Sequence[Frame], photograph: bool) -> str:
    height_px, width_px = frames[0].shape[:2]
    plausible = {
        "side_by_side": width_px >= (_NARROWEST_HALVES if photograph else _NARROWEST_BESIDE) * height_px,
        "top_bottom": width_px <= _WIDEST_ABOVE * height_px,
    }
    alike = {kind: _score_halves(kind, frames) for kind, may_be in plausible.items() if may_be}
    best = max(alike, key=lambda kind: np.nan_to_num(alike[kind], nan=-1))
    if alike[best] >= _ALIKE:
        return best
    example = "side_by_side"
    if np.isnan(alike[best]):
        found = "a picture that is too plain to tell; give two files, left and right"
    elif woven := suspect_interleaving(frames[len(frames) // 2]):
        found, example = f"what looks like {woven}, or a frame of interlaced video in motion", woven
    elif not photograph:
        found = "halves that do not resemble each other; give two files, left and right"
    elif looks_like_anaglyph(frames[0]):
        found = "an anaglyph, which mixes both views into one picture; give the two pictures it was made from"
    else:
        found = (
            "what looks like a single photograph (its halves do not resemble each other); give two files, "
            "left and right"
        )
    expected = "a stereo picture" if photograph else "a 3-D video"
    raise FormatError(
        f"{name}: expected {expected}, two views side by side or one above the other, found {found}",
        remedy=Remedy(f"or choose its layout, such as {example}", ("format",)),
    )


def _looks_squeezed(kind: str, frame: Frame) -> bool:
    height_px, width_px = frame.shape[:2]
    if _HALVES[kind].beside:
        return width_px / 2 < _NARROWEST_EYE * height_px
    return width_px > _WIDEST_EYE * height_px / 2


def _looks_squeezed_photograph(kind: str, frame: Frame) -> bool:
    height_px, width_px = frame.shape[:2]
    if _HALVES[kind].beside:
        aspect = width_px / 2 / height_px
        # A picture with a screen's aspect ratio is made for a 3-D screen, which stretches half-width views.
        if abs(width_px / height_px / _SCREEN - 1) < _SCREEN_TOLERANCE:
            return True
        if _UPRIGHT_EYE <= aspect < _NARROWEST_EYE:
            is_tall = aspect < _TALL_EYE and abs(aspect / _PHONE - 1) > _SCREEN_TOLERANCE
            least = _SQUEEZED_CONTRAST_OF_TALL if is_tall else _SQUEEZED_CONTRAST
            return _measure_contrast_ratio(kind, frame) > least
        return aspect < _UPRIGHT_EYE
    aspect = 2 * width_px / height_px
    if _LOW_EYE < aspect < _LOWEST_EYE:
        return _measure_contrast_ratio(kind, frame) < 1 / _SQUEEZED_CONTRAST
    return aspect >= _LOWEST_EYE


def _measure_contrast_ratio(kind: str, frame: Frame) -> float:
    """Return the ratio of horizontal to vertical contrast between neighbouring pixels."""
    beside, above = 0.0, 0.0
    for eye in _split_halves(kind, frame):
        smaller = min(1.0, _DETAIL_PX / max(eye.shape[:2]))
        size_px = max(round(eye.shape[1] * smaller), 1), max(round(eye.shape[0] * smaller), 1)
        small = cv2.resize(eye, size_px, interpolation=cv2.INTER_AREA)
        # Suppress sensor noise, which is equal along both axes.
        shades = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)
        beside += float(np.abs(np.diff(shades, axis=1)).mean())
        above += float(np.abs(np.diff(shades, axis=0)).mean())
    return beside / max(above, 1e-6)
