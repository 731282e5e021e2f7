"""What one eye sees of the other's points, by a second cast of rays: exact, between pixels too."""

import numpy as np

from stereoweave.synth.rendering.frustum import rays
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.viewpoints import PosedRig
from stereoweave.synth.world import World


def from_the_other_eye(
    world: World, rig: PosedRig, disparity_px: np.ndarray, position: float
) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the eye at `position`, towards the point of its disparity from the other eye:

    the disparity of what that one meets first (NaN if that is beside its picture), and whether it is the
    triangle that the first eye meets.
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
