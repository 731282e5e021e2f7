"""Detection of anaglyphs: single pictures whose colour channels show two views."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

# In red-cyan, green-magenta and amber-blue anaglyphs, one channel shows one view and the others the other.
# In an anaglyph of a real pair (12 pairs, 4 kinds), the median share of moved windows is 0.42, in ordinary
# photographs and in pairs side by side at most 0.10.
MOVED_SHARE, _FEW_WINDOWS = 0.2, 20
_LONGER_SIDE_PX, _DETAIL_PX = 320, 4
_WINDOW_PX, _STEP_PX, _SHIFT_PX, _PLAIN = 24, 16, 24, 3.0
# A window is moved if it correlates at least this well, and this much better than within 1 px of its place.
_CORRELATED, _CLEARLY, _LEAST_SHIFT_PX = 0.6, 0.15, 2


def looks_like_anaglyph(picture: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Return whether one colour channel is moved horizontally against the two others in many places."""
    scale = _LONGER_SIDE_PX / max(picture.shape[:2])
    size_px = max(round(picture.shape[1] * scale), 1), max(round(picture.shape[0] * scale), 1)
    channels = list(cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA).astype(np.float32).T)
    for index, channel in enumerate(channels):
        others = np.mean([other for at, other in enumerate(channels) if at != index], axis=0)
        if measure_moved_share(extract_detail(channel.T), extract_detail(others.T)) > MOVED_SHARE:
            return True
    return False


def extract_detail(shades: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return an image without its large areas of light and shade."""
    return shades - cv2.GaussianBlur(shades, (0, 0), _DETAIL_PX)


def measure_moved_share(here: Float32[np.ndarray, "h w"], there: Float32[np.ndarray, "h w"]) -> float:
    """Return the share of textured windows that lie elsewhere in the other image; 0 if they are too few."""
    height_px, width_px = here.shape
    moved = [
        _is_moved(window, there[top : top + _WINDOW_PX, left - _SHIFT_PX : left + _WINDOW_PX + _SHIFT_PX])
        for top in range(0, height_px - _WINDOW_PX + 1, _STEP_PX)
        for left in range(_SHIFT_PX, width_px - _WINDOW_PX - _SHIFT_PX + 1, _STEP_PX)
        if (window := here[top : top + _WINDOW_PX, left : left + _WINDOW_PX]).std() >= _PLAIN
    ]
    return float(np.mean(moved)) if len(moved) >= _FEW_WINDOWS else 0.0


def _is_moved(window: Float32[np.ndarray, "h w"], strip: Float32[np.ndarray, "h w2"]) -> bool:
    correlation = cv2.matchTemplate(strip, window, cv2.TM_CCOEFF_NORMED)[0]
    best = int(correlation.argmax())
    in_place = correlation[_SHIFT_PX - 1 : _SHIFT_PX + 2].max()
    return bool(
        abs(best - _SHIFT_PX) >= _LEAST_SHIFT_PX
        and correlation[best] > _CORRELATED
        and correlation[best] - in_place > _CLEARLY
    )
