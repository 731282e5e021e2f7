"""How one picture, or a frame of video, holds two eyes: the arrangements, and a guess where none is named."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.errors import FormatError, Remedy
from stereoweave.io.files import SMALLEST_SIDE_PX

Picture = UInt8[np.ndarray, "h w 3"]
Frame = UInt8[np.ndarray, "rows columns 3"]


class Arrangement(NamedTuple):
    """How one frame holds two eyes."""

    beside: bool = True
    half: bool = False
    right_first: bool = False

    def eye_size_px(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Width and height of one eye at its full size; FormatError where the frame cannot be halved."""
        side, extent_px = ("width", width_px) if self.beside else ("height", height_px)
        if extent_px % 2 or extent_px < 2 * SMALLEST_SIDE_PX:
            raise FormatError(
                f"expected an even {side} of at least {2 * SMALLEST_SIDE_PX} pixels for two views, "
                f"found {width_px}x{height_px}; crop it or scale it first"
            )
        if self.half:
            return width_px, height_px
        return (width_px // 2, height_px) if self.beside else (width_px, height_px // 2)

    def eyes(self, frame: Frame) -> tuple[Picture, Picture]:
        """Left and right eye of one frame, each at its full size."""
        first, second = np.split(frame, 2, axis=1 if self.beside else 0)
        if self.half:
            size_px = frame.shape[1], frame.shape[0]
            first, second = (
                cv2.resize(eye, size_px, interpolation=cv2.INTER_CUBIC) for eye in (first, second)
            )
        left, right = (second, first) if self.right_first else (first, second)
        return np.ascontiguousarray(left), np.ascontiguousarray(right)


ARRANGEMENTS = {
    "side_by_side": Arrangement(),
    "side_by_side_half": Arrangement(half=True),
    "top_bottom": Arrangement(beside=False),
    "top_bottom_half": Arrangement(beside=False, half=True),
    "crossed": Arrangement(right_first=True),
    "crossed_half": Arrangement(half=True, right_first=True),
    "top_bottom_right_first": Arrangement(beside=False, right_first=True),
    "top_bottom_right_first_half": Arrangement(beside=False, half=True, right_first=True),
}

_WORDS_IN_NAMES = {
    "side_by_side": {"lr", "lrf", "sbs", "hsbs", "fsbs", "halfsbs", "fullsbs", "parallel"},
    "top_bottom": {"tb", "tbf", "tab", "ou", "htb", "htab", "hou", "halfou", "fulltb", "fullou"},
    "crossed": {"rl", "rlf", "cross", "crossed", "crosseye", "crosseyed"},
}
_HALF = {"half", "hsbs", "halfsbs", "htb", "htab", "hou", "halfou"}
_FULL = {"full", "lrf", "rlf", "tbf", "fsbs", "fullsbs", "fulltb", "fullou"}

# Width to height of one eye. Screens and cameras are 4:3 to 2.4:1; below and above, the eyes were squeezed to
# half. The aspect alone does not tell an upright film, 9:16, which is taken for a squeezed one.
_NARROWEST_EYE, _WIDEST_EYE = 1.2, 2.5
# Photographs are upright, square or wide. Where their aspect may be that of a full eye as well as that of a
# squeezed one, the contrast of neighbours beside each other tells, divided by that of those above each other:
# in the median of painted pictures it is 0.96 of full eyes, 1.58 where the width was squeezed to half, 0.57
# where the height was.
_UPRIGHT_EYE, _LOW_EYE, _LOWEST_EYE, _SQUEEZED_CONTRAST = 0.5, 2.0, 3.0, 1.25
_SCREEN, _SCREEN_TOLERANCE = 16 / 9, 0.01
_DETAIL_PX = 480
# Width to height of a whole frame: two upright telephones beside each other are at least as wide, and the
# widest film in two squeezed halves, one above the other, is at most as wide.
_NARROWEST_BESIDE, _WIDEST_ABOVE = 1.05, 2.45

# 95 in 100 painted or rendered pairs, of which many have disparities far above those of films, resemble each
# other by 0.34 or more; the halves of single pictures by 0.13 at most, of blurred enlargements by 0.23.
_ALIKE = 0.3
_SMALL_PX = 160, 120
_WINDOW_PX, _STEP_PX, _SHIFT_PX, _OFF_PX = 20, 10, 32, 2
_PLAIN, _FEW_WINDOWS, _AGREE_PX = 3.0, 6, 3


def guess_arrangement(
    name: str,
    frames: Sequence[Frame],
    declared: str | None = None,
    *,
    photograph: bool = False,
) -> str:
    """The name in `ARRANGEMENTS` that a film has: as its container declares, as its name says, as it looks.

    What the name says must be borne out by the look, unless the frames are too plain to tell: "LR" has
    other meanings too. Which eye comes first cannot be seen: the left one, unless declaration or name differ.

    Args:
        name: The file; words of its name, without its folders', may say it: film_SBS, film-half-OU.
        frames: Some frames of the film, far from each other.
        declared: What the container says, a name in `ARRANGEMENTS` of full size, which half ones may be.
        photograph: Whether it is no film but one photograph, which may be upright.

    Raises:
        FormatError: The two halves of the frames do not resemble each other, whichever way they are split;
            or an arrangement is declared that is none of `ARRANGEMENTS`.
    """
    if declared not in (None, *ARRANGEMENTS):
        raise FormatError(
            f"{name}: expected two views side by side, or the left one above the right one, found a video "
            f"that declares {declared}",
            remedy=Remedy(f"if that is wrong, choose one of {', '.join(ARRANGEMENTS)}", ("arrangement",)),
        )
    words = set(re.split(r"[^a-z0-9]+", Path(name).name.lower()))
    named = next((kind for kind, marks in _WORDS_IN_NAMES.items() if marks & words), None)
    kind = declared or _confirmed(named, frames) or _seen(name, frames, photograph)
    looks_squeezed = _looks_squeezed_photograph if photograph else _looks_squeezed
    squeezed = bool(words & _HALF) or (not words & _FULL and looks_squeezed(kind, frames[0]))
    return f"{kind}_half" if squeezed else kind


def resemblance(first: Picture, second: Picture) -> float:
    """How far two pictures show one scene from two places, 0 to 1; NaN where they are too plain to tell.

    Windows of the one are sought in the other, up to a fifth of the width aside. The median of their best
    correlations, times the share of neighbouring windows that are found displaced alike: repeated patterns
    correlate as well, but here and there. Both pictures are brought to one small size and freed of shades
    wider than a window, for skies and floors are alike everywhere.
    """
    here, there = _details(first), _details(second)
    rows = range(_OFF_PX, _SMALL_PX[1] - _WINDOW_PX - _OFF_PX + 1, _STEP_PX)
    columns = range(0, _SMALL_PX[0] - _WINDOW_PX + 1, _STEP_PX)
    found = np.array([[_sought(here, there, top, left) for left in columns] for top in rows])
    correlation, shift_px = found[..., 0], found[..., 1]
    steps_px = np.concatenate([np.diff(shift_px, axis=axis).ravel() for axis in (0, 1)])
    steps_px = np.abs(steps_px[~np.isnan(steps_px)])
    if np.isfinite(correlation).sum() < _FEW_WINDOWS or not steps_px.size:
        return np.nan
    return float(max(np.nanmedian(correlation), 0) * np.mean(steps_px <= _AGREE_PX))


def _sought(
    here: Float32[np.ndarray, "h w"], there: Float32[np.ndarray, "h w"], top: int, left: int
) -> tuple[float, float]:
    """Best correlation of a window, and the shift in pixels where it is; NaN for a plain window."""
    window = here[top : top + _WINDOW_PX, left : left + _WINDOW_PX]
    if window.std() < _PLAIN:
        return np.nan, np.nan
    start = max(left - _SHIFT_PX, 0)
    strip = there[top - _OFF_PX : top + _WINDOW_PX + _OFF_PX, start : left + _WINDOW_PX + _SHIFT_PX]
    _, best, _, (column, _) = cv2.minMaxLoc(cv2.matchTemplate(strip, window, cv2.TM_CCOEFF_NORMED))
    return best, start + column - left


def _details(picture: Picture) -> Float32[np.ndarray, "120 160"]:
    grey = cv2.cvtColor(cv2.resize(picture, _SMALL_PX, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    shades = grey.astype(np.float32)
    return shades - cv2.GaussianBlur(shades, (0, 0), _WINDOW_PX / 5)


def _alike(kind: str, frames: Sequence[Frame]) -> float:
    """The median resemblance of the two halves, NaN where no frame tells."""
    scores = [resemblance(*_halves(kind, frame)) for frame in frames]
    told = [score for score in scores if not np.isnan(score)]
    return float(np.median(told)) if told else np.nan


def _halves(kind: str, frame: Frame) -> tuple[Picture, Picture]:
    height_px, width_px = frame.shape[0] // 2, frame.shape[1] // 2
    if ARRANGEMENTS[kind].beside:
        return frame[:, :width_px], frame[:, -width_px:]
    return frame[:height_px], frame[-height_px:]


def _confirmed(named: str | None, frames: Sequence[Frame]) -> str | None:
    return None if named is None or _alike(named, frames) < _ALIKE else named


def _seen(name: str, frames: Sequence[Frame], photograph: bool) -> str:
    height_px, width_px = frames[0].shape[:2]
    thinkable = {
        "side_by_side": width_px >= _NARROWEST_BESIDE * height_px,
        "top_bottom": width_px <= _WIDEST_ABOVE * height_px,
    }
    alike = {kind: _alike(kind, frames) for kind, may_be in thinkable.items() if may_be}
    best = max(alike, key=lambda kind: np.nan_to_num(alike[kind], nan=-1))
    if alike[best] >= _ALIKE:
        return best
    found = (
        "too plain a picture to tell" if np.isnan(alike[best]) else "halves that do not resemble each other"
    )
    expected = "a stereo picture" if photograph else "3-D video"
    raise FormatError(
        f"{name}: expected {expected}, two views side by side or one above the other, found {found}; "
        "give two files, left and right",
        remedy=Remedy(f"or choose one of {', '.join(ARRANGEMENTS)}", ("arrangement",)),
    )


def _looks_squeezed(kind: str, frame: Frame) -> bool:
    height_px, width_px = frame.shape[:2]
    if ARRANGEMENTS[kind].beside:
        return width_px / 2 < _NARROWEST_EYE * height_px
    return width_px > _WIDEST_EYE * height_px / 2


def _looks_squeezed_photograph(kind: str, frame: Frame) -> bool:
    height_px, width_px = frame.shape[:2]
    if ARRANGEMENTS[kind].beside:
        aspect = width_px / 2 / height_px
        # Both in one picture of a screen's aspect are made for a screen.
        if abs(width_px / height_px / _SCREEN - 1) < _SCREEN_TOLERANCE:
            return True
        if _UPRIGHT_EYE <= aspect < _NARROWEST_EYE:
            return _contrast_beside(kind, frame) > _SQUEEZED_CONTRAST
        return aspect < _UPRIGHT_EYE
    aspect = 2 * width_px / height_px
    if _LOW_EYE < aspect < _LOWEST_EYE:
        return _contrast_beside(kind, frame) < 1 / _SQUEEZED_CONTRAST
    return aspect >= _LOWEST_EYE


def _contrast_beside(kind: str, frame: Frame) -> float:
    """The contrast of neighbours beside each other, divided by that of those above each other."""
    beside, above = 0.0, 0.0
    for eye in _halves(kind, frame):
        smaller = min(1.0, _DETAIL_PX / max(eye.shape[:2]))
        size_px = max(round(eye.shape[1] * smaller), 1), max(round(eye.shape[0] * smaller), 1)
        small = cv2.resize(eye, size_px, interpolation=cv2.INTER_AREA)
        # So that the grain of the sensor, alike along both, does not count.
        shades = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)
        beside += float(np.abs(np.diff(shades, axis=1)).mean())
        above += float(np.abs(np.diff(shades, axis=0)).mean())
    return beside / max(above, 1e-6)
