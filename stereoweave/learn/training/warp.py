"""The left image made from the right one, differentiable in disparity; and disparity made from depth."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def reconstruct_left(
    right: Float[Tensor, "b c h w"], disparity_px: Float[Tensor, "b 1 h w"]
) -> tuple[Float[Tensor, "b c h w"], Bool[Tensor, "b 1 h w"]]:
    """The left image as the right one shows it, and which of its pixels the right one contains.

    Pixel (i, j) is read from (i - d, j) of the right image, between its two neighbours in the row, and exists
    where 0 <= i - d <= W - 1; elsewhere its value means nothing and has no gradient.

    Args:
        right: Right image [B, C, H, W], at least 2 wide.
        disparity_px: Disparity of the left view; not finite counts as not existing.
    """
    last = right.shape[3] - 1
    # In float32: half-precision disparity would draw whole numbers down with it, and bfloat16 ends at 256.
    columns = torch.arange(last + 1, device=right.device, dtype=torch.float32)
    position_px = columns - disparity_px
    exists = (position_px >= 0) & (position_px <= last)
    # Replaced before it is used: no index outside the row, and no infinity that meets a gradient of 0.
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
    """Disparity f B / z - doffs in pixels, finite in value and gradient for any depth, 0 included.

    Nearer than f B / (width + |doffs|) the match lies outside the right image anyway; there the disparity
    stays at the width or just above, without a gradient.

    Args:
        depth_m: Depth of the left view.
        focal_baseline_px_m: Each sample's focal length in pixels times its baseline in metres.
        doffs_px: The right camera's cx minus the left's.
        width_px: Width of the images.
    """
    nearest_m = focal_baseline_px_m / (width_px + doffs_px.abs())
    return focal_baseline_px_m / depth_m.clamp(min=nearest_m) - doffs_px
