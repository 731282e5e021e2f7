"""Optional stages for a trained WeaveNet; they do not change its output until they are trained."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.layers import (
    ConvBlock,
    Halve,
    Residual,
    gather_neighbours,
    mean_around,
    sample_at_match,
    zero_initialise,
)

# Offsets (rows, columns) at which the completion looks for the background, in quarter-resolution pixels.
OFFSETS = tuple(
    (sign * step * down, sign * step * along)
    for down, along, steps in ((0, 1, (2, 4, 8, 16, 32)), (1, 0, (2, 4, 8, 16)))
    for step in steps
    for sign in (-1, 1)
)
# Left-right differences are clamped to this magnitude, in quarter-resolution pixels.
_LARGEST_CHECK = 4.0


class WiderContext(nn.Module):
    """Context at 1/32 resolution, added to the context at 1/16 resolution."""

    def __init__(self, channels: int, wider: int) -> None:
        super().__init__()
        self.down = Halve(channels, wider)
        self.body = nn.Sequential(*(Residual(wider, dilation) for dilation in (1, 2)))
        self.up = zero_initialise(nn.Conv2d(wider, channels, 1))

    def forward(self, wide: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return wide + F.interpolate(self.up(self.body(self.down(wide))), scale_factor=2.0)


class Completion(nn.Module):
    """Completion of the disparity at 1/4 resolution where the two views disagree.

    An occluded pixel has no match. The left-right check finds such pixels, and each is assigned a convex
    combination of the disparities 2 to 32 pixels away in its row and column. The weights are learned
    affinities, as in spatial propagation networks (Liu et al., NeurIPS 2017), but with fixed, distant offsets
    instead of repeated steps.
    """

    def __init__(self, quarter: int, channels: int) -> None:
        super().__init__()
        self.join = ConvBlock(32 + quarter + 4, channels, kernel=1)
        self.body = ConvBlock(channels, channels, dilation=2)
        self.affinity = nn.Conv2d(channels, len(OFFSETS), 1)
        self.share = zero_initialise(nn.Conv2d(channels, 1, 1))
        self.decoded = zero_initialise(nn.Conv2d(channels, 32, 1))

    def forward(
        self,
        disparity: Float[Tensor, "b 1 h w"],
        other: Float[Tensor, "b 1 h w"],
        quarter: Float[Tensor, "b c h w"],
        decoded: Float[Tensor, "b 32 h w"],
    ) -> tuple[Tensor, Tensor]:
        """Return the completed disparity in quarter-resolution pixels, and the updated decoder features.

        Args:
            disparity: Disparity in quarter-resolution pixels.
            other: The other view's disparity, in that view's own columns.
            quarter: The encoder's features.
            decoded: The decoder's features.
        """
        x = self.body(self.join(torch.cat([decoded, quarter, *self._checks(disparity, other)], 1)))
        around = gather_neighbours(disparity, OFFSETS)
        affinity = self.affinity(x).float()
        weights = (affinity - affinity.amax(1, keepdim=True)).exp()
        mixed = (weights * around).sum(1, keepdim=True) / weights.sum(1, keepdim=True)
        share = self.share(x).float().tanh()
        return disparity + share * (mixed - disparity), decoded + self.decoded(x)

    def _checks(self, disparity: Tensor, other: Tensor) -> tuple[Tensor, ...]:
        """Return occlusion cues: deviation from the mean, disparity, left-right check and border check."""
        columns = torch.arange(disparity.shape[3], dtype=torch.float32, device=disparity.device)
        # In float32, because near a disparity of 100 px bfloat16 cannot resolve the slope of a surface.
        departure = disparity - mean_around(disparity, 9)
        check = (sample_at_match(other, disparity) - disparity).clamp(-_LARGEST_CHECK, _LARGEST_CHECK)
        inside = (columns - disparity).clamp(-_LARGEST_CHECK, _LARGEST_CHECK)
        return departure, disparity / 16, check, inside
