"""Views and layouts of two views in more than 8 bits."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt16

from stereoweave.rendering.layouts import squeeze
from stereoweave.rendering.renderer import Renderer

_WHITE_16_BITS = 255 * 256


class _Arrangement(NamedTuple):
    """How two views are joined: the axis, whether the right one comes first, and whether each is squeezed."""

    axis: int
    right_first: bool = False
    squeezed: bool = False


FINE_LAYOUTS = {
    "side_by_side": _Arrangement(1),
    "side_by_side_half": _Arrangement(1, squeezed=True),
    "crossed": _Arrangement(1, right_first=True),
    "top_bottom": _Arrangement(0),
    "top_bottom_half": _Arrangement(0, squeezed=True),
}


def compose_fine(renderer: Renderer, layout: str) -> UInt16[np.ndarray, "h w 3"]:
    """Return a layout of both eyes' views in 16 bits; `layout` is a name in `FINE_LAYOUTS`."""
    axis, right_first, squeezed = FINE_LAYOUTS[layout]
    eyes = [renderer.fine_view(position) for position in ((1.0, 0.0) if right_first else (0.0, 1.0))]
    return to_16_bits(np.concatenate([squeeze(eye, axis) for eye in eyes] if squeezed else eyes, axis))


def to_16_bits(picture: Float32[np.ndarray, "h w 3"]) -> UInt16[np.ndarray, "h w 3"]:
    """Return a picture from 0 to 255 as one from 0 to 65280, which FFmpeg takes for white."""
    return np.clip(np.rint(_WHITE_16_BITS / 255 * picture), 0, _WHITE_16_BITS).astype(np.uint16)


def to_8_bits(picture: Float32[np.ndarray, "h w 3"]) -> np.ndarray:
    """Return a picture rounded to uint8 [H, W, 3]."""
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
