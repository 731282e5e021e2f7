"""Exact visibility of one eye's points from the other eye, by casting rays a second time."""

import numpy as np

from stereoweave.synth.rendering.frustum import rays
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.viewpoints import PosedRig
from stereoweave.synth.world import World


def from_the_other_eye(
    world: World, rig: PosedRig, disparity_px: np.ndarray, position: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cast rays from the other eye to the point at the disparity of each pixel of the eye at `position`.

    Returns the disparity of the surface that the ray meets first (NaN if outside the other eye's image), and
    whether that is the triangle that the first eye sees.
    """
    camera, caster = rig.camera, Raycaster()
    away = 1 - 2 * position  # to the right for the left eye
    shift = away * disparity_px[..., None] / camera.focal_px * rig.axes[0]  # baseline / depth, at depth 1
    depth_m, triangle = caster.cast_rays(world, rig.eye_m(1 - position), rays(rig) - shift)
    _, own_triangle = caster.cast_rays(world, rig.eye_m(position), rays(rig))
    match_px = np.arange(rig.size_px[0]) - away * disparity_px
    beside = (match_px < 0) | (match_px > rig.size_px[0] - 1)
    there_px = np.where(beside, np.nan, camera.disparity_px(depth_m))
    return there_px, (triangle == own_triangle) & (triangle >= 0) & ~beside
