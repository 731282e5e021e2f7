"""Views and layouts of two views in more than 8 bits."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, UInt16

from stereoweave.rendering.floating_windows import cut_windows
from stereoweave.rendering.layouts import Eye
from stereoweave.rendering.renderer import Renderer

_WHITE_16_BITS = 255 * 256


def compose_fine(
    renderer: Renderer, join: Callable[[Eye, Eye], Eye], windows_px: tuple[float, float] = (0.0, 0.0)
) -> UInt16[np.ndarray, "h w 3"]:
    """Return a layout of both eyes' views in 16 bits.

    Args:
        renderer: Renderer with fine images.
        join: The layout's function of this name.
        windows_px: See `LayoutOptions`.
    """
    eyes = renderer.fine_view(0.0), renderer.fine_view(1.0)
    return to_16_bits(join(*cut_windows(eyes, windows_px)))


def to_16_bits(picture: Float32[np.ndarray, "h w 3"]) -> UInt16[np.ndarray, "h w 3"]:
    """Return a picture from 0 to 255 as one from 0 to 65280, which FFmpeg takes for white."""
    return np.clip(np.rint(_WHITE_16_BITS / 255 * picture), 0, _WHITE_16_BITS).astype(np.uint16)


def to_8_bits(picture: Float32[np.ndarray, "h w 3"]) -> np.ndarray:
    """Return a picture rounded to uint8 [H, W, 3]."""
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
