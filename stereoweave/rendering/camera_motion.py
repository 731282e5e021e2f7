"""Warping of a rendered view to a camera that is moved up and forward."""

import numpy as np
from jaxtyping import Float

from stereoweave.rendering.camera_motion_kernels import move
from stereoweave.rendering.canvas_kernels import Canvas, empty_canvas
from stereoweave.rendering.hole_filling_kernels import fill
from stereoweave.stereo import StereoCamera

# Limit on forward motion, as a share of a point's depth; beyond it, the point would fill the image.
_MOST_APPROACH = 0.5


def move_camera(canvas: Canvas, camera: StereoCamera, offset_px: float, up: float, forward: float) -> Canvas:
    """Warp a view to a camera moved up and forward: first along the rows, then along the columns.

    The depth in baselines is z = focal_px / inverse_px. Forward motion magnifies each point about the
    principal point by z / (z - forward) = 1 + forward * inverse_px / focal_px, where inverse_px is the value
    after the motion.

    Args:
        canvas: A view from a position on the line through the cameras, with holes filled.
        camera: The left camera.
        offset_px: Shift of the view's principal point to the right of the left camera's principal point.
        up: Upward motion, in baselines.
        forward: Motion towards the scene, in baselines.
    """
    height, width = canvas.surface_px.shape
    inverse_px = np.maximum(canvas.surface_px + camera.doffs_px, 0)
    inverse_px = inverse_px / (1 - np.minimum(forward * inverse_px / camera.focal_px, _MOST_APPROACH))
    columns = _magnify(np.arange(width), camera.cx_px + offset_px, forward * inverse_px / camera.focal_px)
    canvas = _move_rows(canvas, columns, inverse_px - camera.doffs_px)
    inverse_px = np.maximum(canvas.surface_px + camera.doffs_px, 0)
    rows = _magnify(np.arange(height)[:, None], camera.cy_px, forward * inverse_px / camera.focal_px)
    turned = _transpose(canvas)
    return _transpose(_move_rows(turned, (rows + up * inverse_px).T, turned.surface_px))


def _magnify(
    places: np.ndarray, centre_px: float, growth: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Return positions of rows or columns, magnified about a centre by each pixel's factor 1 + growth."""
    return places + (places - centre_px) * growth


def _move_rows(
    canvas: Canvas, targets: Float[np.ndarray, "h w"], disparity_px: Float[np.ndarray, "h w"]
) -> Canvas:
    """Move each pixel to its target column, with its new disparity, and fill the holes."""
    result = empty_canvas(canvas.image)
    ends = (np.ascontiguousarray(x, np.float32) for x in (targets, disparity_px))
    move(canvas.image, canvas.surface_px, canvas.drawn, *ends, result)
    fill(result)
    return result


def _transpose(canvas: Canvas) -> Canvas:
    """Return the canvas with rows and columns swapped."""
    return Canvas(*(np.ascontiguousarray(x.swapaxes(0, 1)) for x in canvas))
