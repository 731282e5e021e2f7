"""Projection matrices, rays and frustum culling for a rig's cameras."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from stereoweave.synth.viewpoints import PosedRig

# Distance of the near plane; the 24-bit depth buffer covers the range from there to infinity.
NEAR_M = 0.1


def projection(rig: PosedRig) -> Float[np.ndarray, "4 4"]:
    """Return the matrix from camera coordinates (right, down, forward, 1) to OpenGL's clip space.

    Frame buffer rows run downwards like image rows, so reading them needs no flip. Pixel centres
    are at integers in the rig, and at half-integers in OpenGL.
    """
    width_px, height_px = rig.size_px
    camera = rig.camera
    return np.array(
        [
            [2 * camera.focal_px / width_px, 0, (2 * camera.cx_px + 1) / width_px - 1, 0],
            [0, 2 * camera.focal_px / height_px, (2 * camera.cy_px + 1) / height_px - 1, 0],
            [0, 0, 1, -2 * NEAR_M],
            [0, 0, 1, 0],
        ]
    )


def triangles_in_view(
    corners_m: Float[np.ndarray, "3 3 n"], rig: PosedRig, positions: Sequence[float]
) -> Int[np.ndarray, " k"]:
    """Return the indices of the triangles in view from any of the positions, roughly from near to far.

    Near triangles come first, because the depth test then skips the shading of triangles behind them.
    `corners_m` is a contiguous `Mesh.corners_m.T`, indexed by axis, corner and triangle.
    """
    away_m = corners_m.reshape(3, -1) - rig.position_m.astype(np.float32)[:, None]
    right, down, forward = (rig.axes.astype(np.float32) @ away_m).reshape(corners_m.shape)
    (left_edge, right_edge), (upper_edge, lower_edge) = _image_edges(rig).astype(np.float32)
    shift_m = np.float32(rig.camera.baseline_m) * np.array([min(positions), max(positions)], np.float32)
    outside = (
        (forward < NEAR_M).all(0)
        | (right < left_edge * forward + shift_m[0]).all(0)
        | (right > right_edge * forward + shift_m[1]).all(0)
        | (down < upper_edge * forward).all(0)
        | (down > lower_edge * forward).all(0)
    )
    seen = np.flatnonzero(~outside)
    # Sort by the farthest corner, so that large ground triangles follow the objects on them. Positive floats
    # have the same order as their bits, and sorting 16 bits is fast.
    farthest_m = forward.max(0)[seen]
    return seen[np.argsort((farthest_m.view(np.uint32) >> 16).astype(np.uint16), kind="stable")]


def _image_edges(rig: PosedRig) -> Float[np.ndarray, "2 2"]:
    """Return the coordinates of the image's borders at depth 1, as [[left, right], [top, bottom]]."""
    camera, (width_px, height_px) = rig.camera, rig.size_px
    borders_px = np.array([[-0.5, width_px - 0.5], [-0.5, height_px - 0.5]])
    return (borders_px - [[camera.cx_px], [camera.cy_px]]) / camera.focal_px


def direction_matrix(rig: PosedRig, samples: int) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from OpenGL's (column, row, 1) to world directions, scaled to depth 1.

    Columns and rows are counted in samples; each pixel has `samples` x `samples` of them.
    """
    camera = rig.camera
    to_camera = np.array(
        [
            [1 / samples, 0, -0.5 - camera.cx_px],
            [0, 1 / samples, -0.5 - camera.cy_px],
            [0, 0, camera.focal_px],
        ]
    )
    return rig.axes.T @ to_camera / camera.focal_px


def rays(rig: PosedRig, samples: int = 1) -> Float[np.ndarray, "h w 3"]:
    """Return the world directions, scaled to depth 1, of `samples` x `samples` rays through each pixel.

    A single ray goes through the pixel's centre.
    """
    width, height = (side * samples for side in rig.size_px)
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([column, row, np.ones_like(row)], -1) @ direction_matrix(rig, samples).T
