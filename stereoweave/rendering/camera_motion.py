"""A drawn view as a camera sees it that is moved up and forward too."""

import numpy as np
from jaxtyping import Float

from stereoweave.rendering.camera_motion_kernels import move
from stereoweave.rendering.canvas_kernels import Canvas, empty_canvas
from stereoweave.rendering.hole_filling_kernels import fill
from stereoweave.stereo import StereoCamera

# A camera that goes forward by more than this share of a point's depth has it all over the picture.
_MOST_APPROACH = 0.5


def move_camera(canvas: Canvas, camera: StereoCamera, offset_px: float, up: float, forward: float) -> Canvas:
    """The view from above and before the place that the canvas was drawn for: rows first, then columns.

    With depth z in baselines, z = focal_px / inverse_px. Forward, everything grows about the centre by
    z / (z - forward), which is 1 + forward * inverse_px / focal_px with inverse_px after the move.

    Args:
        canvas: A view from the line through the cameras, filled.
        camera: Of the left photograph.
        offset_px: How far the view's principal point lies to the right of that one's.
        up: In baselines.
        forward: In baselines.
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
    """Where these rows or columns are after growing about a centre, each pixel by its own share."""
    return places + (places - centre_px) * growth


def _move_rows(
    canvas: Canvas, targets: Float[np.ndarray, "h w"], disparity_px: Float[np.ndarray, "h w"]
) -> Canvas:
    """The view with each pixel at its target column, where it has that disparity; filled."""
    result = empty_canvas(canvas.image)
    ends = (np.ascontiguousarray(x, np.float32) for x in (targets, disparity_px))
    move(canvas.image, canvas.surface_px, canvas.drawn, *ends, result)
    fill(result)
    return result


def _transpose(canvas: Canvas) -> Canvas:
    """Rows for columns."""
    return Canvas(*(np.ascontiguousarray(x.swapaxes(0, 1)) for x in canvas))
