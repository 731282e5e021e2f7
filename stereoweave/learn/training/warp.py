"""Differentiable warping of the right image to the left view, and conversion of depth to disparity."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def reconstruct_left(
    right: Float[Tensor, "b c h w"], disparity_px: Float[Tensor, "b 1 h w"]
) -> tuple[Float[Tensor, "b c h w"], Bool[Tensor, "b 1 h w"]]:
    """Warp the right image to the left view. Returns the warped image and the mask of pixels with a match.

    Pixel (i, j) with disparity d is interpolated linearly at (i - d, j) in the right image. It has a match if
    0 <= i - d <= W - 1; otherwise its value is meaningless and has no gradient.

    Args:
        right: Right image [B, C, H, W], at least 2 pixels wide.
        disparity_px: Disparity of the left view; pixels with non-finite values have no match.
    """
    last = right.shape[3] - 1
    # In float32: bfloat16 has no odd integers above 256.
    columns = torch.arange(last + 1, device=right.device, dtype=torch.float32)
    position_px = columns - disparity_px
    exists = (position_px >= 0) & (position_px <= last)
    # Positions outside the image are replaced first, so that every index is in the row and no infinity is
    # multiplied by a gradient of 0.
    position_px = position_px.where(exists, 0)
    start = position_px.detach().floor().clamp(max=last - 1)
    first, second = (right.gather(3, (start.long() + i).expand_as(right)) for i in (0, 1))
    return first + (position_px - start) * (second - first), exists


def depth_to_disparity(
    depth_m: Float[Tensor, "b 1 h w"],
    focal_baseline_px_m: Float[Tensor, "b 1 1 1"],
    doffs_px: Float[Tensor, "b 1 1 1"],
    width_px: int,
) -> Float[Tensor, "b 1 h w"]:
    """Return the disparity f B / z - doffs in px. Value and gradient are finite for any depth, including 0.

    Below a depth of f B / (width + |doffs|), the match lies outside the right image. The disparity is then
    clamped to its value at this depth, and has no gradient.

    Args:
        depth_m: Depth of the left view.
        focal_baseline_px_m: Each sample's focal length in pixels times its baseline in metres.
        doffs_px: The right camera's cx minus the left's.
        width_px: Width of the images.
    """
    nearest_m = focal_baseline_px_m / (width_px + doffs_px.abs())
    return focal_baseline_px_m / depth_m.clamp(min=nearest_m) - doffs_px
