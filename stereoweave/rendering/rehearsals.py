"""Rehearsals of view synthesis, which compile its kernels (`compiling_ahead.compile_ahead`).

There are two, for two processes: `rehearse_drawing` compiles the kernel `draw`, which takes longer to compile
than all others together.
"""

import numpy as np

from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair

_SIDE_PX = 32


def rehearse_drawing() -> None:
    """Render a small view from between the cameras."""
    _renderer().view(0.5)


def rehearse_filling() -> None:
    """Fill the holes of a small canvas, for views from between and beyond the cameras."""
    from stereoweave.rendering.canvas_kernels import empty_canvas
    from stereoweave.rendering.hole_filling_kernels import fill, paint_background

    background = _renderer().find_background(right=False)
    canvas = empty_canvas(background.colours)
    paint_background(*background, 0.0, 0.0, canvas)
    fill(canvas)


def rehearse_fine_drawing() -> None:
    """Render a small view in more than 8 bits, and fill its holes, from between and beyond the cameras."""
    renderer = _renderer(fine=True)
    for position in (0.5, 1.5):
        renderer.fine_view(position)


def rehearse_moving() -> None:
    """Render a small view from above the line through the cameras."""
    _renderer().view(0.5, up=0.5)


def _renderer(*, fine: bool = False) -> Renderer:
    image, px = np.zeros((_SIDE_PX, _SIDE_PX, 3), np.uint8), np.zeros((_SIDE_PX, _SIDE_PX), np.float32)
    estimate = Estimate(disparity_px=px, right_disparity_px=px, confidence=px, occluded=px > 0)
    pictures = (image.astype(np.float32),) * 2 if fine else None
    return Renderer(StereoPair(left=image, right=image), estimate, threads=1, fine=pictures)
