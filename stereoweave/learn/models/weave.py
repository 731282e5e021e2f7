"""WeaveNet: the paper's dilated dense blocks and step-wise decoder around a correlation of shared features.

The paper matches by convolution over the two views laid on each other and pooled by 8; what it learns is
tied to the pictures it saw. WeaveNet compares features of one encoder instead, and keeps from the paper the
dilated, densely connected blocks, the decoder in steps of two, and the skip connections from the image.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.layers import (
    ConvBlock,
    DilatedDense,
    Halve,
    Residual,
    correlation_volume,
    expected_step,
    local_soft_argmax,
    mirrored,
    nearby_matches,
    upsample_convex,
)


@dataclass(frozen=True, kw_only=True)
class Stages:
    """Every step of a prediction, for the losses; both views as one batch, the second half mirrored.

    Attributes:
        correlation: raw matching scores a level of 4 px at 1/4 resolution [2B, D, H/4, W/4].
        scores: the same after aggregation.
        coarse_px: disparity read from `scores`, at half resolution, in pixels of the full one.
        disparity_px: the final one [2B, 1, H, W].
        confidence_logit: log odds of being within 1 px [2B, 1, H, W].
    """

    correlation: Float[Tensor, "b d h4 w4"]
    scores: Float[Tensor, "b d h4 w4"]
    coarse_px: Float[Tensor, "b 1 h2 w2"]
    disparity_px: Float[Tensor, "b 1 h w"]
    confidence_logit: Float[Tensor, "b 1 h w"]


class Features(NamedTuple):
    """Feature maps of an image at 1/2, 1/4 and 1/8 of its resolution."""

    half: Tensor
    quarter: Tensor
    eighth: Tensor

    def mirrored(self) -> "Features":
        return Features(*(mirrored(map_) for map_ in self))


class Encoder(nn.Module):
    """Features of one view: down to 1/16, and up again so that the finer maps know the wider surroundings."""

    def __init__(self) -> None:
        super().__init__()
        self.down_to_half = nn.Sequential(Halve(3, 16, kernel=4), ConvBlock(16, 16))
        self.down_to_quarter = nn.Sequential(Halve(16, 32), Residual(32))
        self.down_to_eighth = nn.Sequential(Halve(32, 64), Residual(64))
        self.down_to_sixteenth = nn.Sequential(Halve(64, 96), Residual(96))
        self.up_to_eighth = ConvBlock(96, 64, kernel=1)
        self.up_to_quarter = ConvBlock(64, 32, kernel=1)
        self.join = ConvBlock(32, 32)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Features:
        half = self.down_to_half(image * 2 - 1)
        quarter = self.down_to_quarter(half)
        eighth = self.down_to_eighth(quarter)
        eighth = eighth + F.interpolate(self.up_to_eighth(self.down_to_sixteenth(eighth)), scale_factor=2.0)
        quarter = quarter + F.interpolate(self.up_to_quarter(eighth), scale_factor=2.0)
        return Features(half, self.join(quarter), eighth)


class Aggregation(nn.Module):
    """Matching scores made sure of by their surroundings: dilated dense blocks at 1/8, decoded to 1/4."""

    def __init__(self, levels: int) -> None:
        super().__init__()
        self.down = Halve(levels + 32, 64)
        self.dense = DilatedDense(64 + 64, narrow=32, growth=32, dilations=(1, 2, 4, 8, 1))
        self.bottleneck = ConvBlock(self.dense.outputs, 48, kernel=1)
        self.join = ConvBlock(48 + levels + 32, 32, kernel=1)
        self.decode = ConvBlock(32, 32)
        self.scores = nn.Conv2d(32, levels, 1)

    def forward(self, correlation: Tensor, features: Features) -> tuple[Tensor, Tensor]:
        """Scores [B, D, H/4, W/4] and the decoder's features [B, 32, H/4, W/4]."""
        matches = torch.cat([correlation, features.quarter], 1)
        wide = self.bottleneck(self.dense(torch.cat([self.down(matches), features.eighth], 1)))
        decoded = self.decode(self.join(torch.cat([F.interpolate(wide, scale_factor=2.0), matches], 1)))
        return correlation + self.scores(decoded), decoded


class Refinement(nn.Module):
    """A correction of at most `radius` pixels at half resolution, read from matches around the estimate."""

    def __init__(self, radius: int = 2) -> None:
        super().__init__()
        self.radius = radius
        nearby = 2 * radius + 1
        self.join = ConvBlock(nearby + 16 + 8, 16, kernel=1)
        self.body = Residual(16)
        self.scores = nn.Conv2d(16, nearby, 1)
        self.weights = nn.Conv2d(16, 36, 1)
        self.confidence = nn.Conv2d(16, 1, 1)

    def forward(
        self, disparity: Tensor, first: Tensor, second: Tensor, context: Tensor, decoded: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Disparity in pixels of this resolution, the weights of the last upsampling, and the confidence."""
        matches = nearby_matches(first, second, disparity, self.radius)
        x = self.body(self.join(torch.cat([matches, context, decoded], 1)))
        correction = expected_step((matches + self.scores(x)).float())
        return disparity + correction, self.weights(x), self.confidence(x)


class WeaveNet(nn.Module):
    """Disparity of both views of a rectified pair, and the left one's confidence.

    Sides must be multiples of 16. Disparities from 0 to `levels` * 4 - 1 px are found. 451,262 parameters;
    5.86 G multiply-adds for both views at 640x480.
    """

    multiple_of = 16

    def __init__(self, levels: int = 48) -> None:
        super().__init__()
        self.levels = levels
        self.encoder = Encoder()
        self.to_match = nn.Conv2d(32, 32, 1)
        self.aggregation = Aggregation(levels)
        self.weights = nn.Conv2d(32, 36, 1)
        self.to_match_half = nn.Conv2d(16, 16, 1)
        self.to_half = nn.Conv2d(32, 32, 1)
        self.refinement = Refinement()

    @property
    def max_disparity_px(self) -> int:
        return 4 * self.levels

    def stages(self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]) -> Stages:
        """Every step of the prediction for both views."""
        batch = len(left)
        maps = self.encoder(torch.cat([left, right]))
        left_maps, right_maps = Features(*(m[:batch] for m in maps)), Features(*(m[batch:] for m in maps))
        # In a mirror the right view is a left one, so that one aggregation serves both.
        first = Features(*map(torch.cat, zip(left_maps, right_maps.mirrored(), strict=True)))
        second = Features(*map(torch.cat, zip(right_maps, left_maps.mirrored(), strict=True)))
        correlation = correlation_volume(
            self.to_match(first.quarter), self.to_match(second.quarter), self.levels
        )
        scores, decoded = self.aggregation(correlation, first)
        coarse = upsample_convex(local_soft_argmax(scores.float()) * 2, self.weights(decoded).float())
        fine, weights, confidence = self.refinement(
            coarse,
            self.to_match_half(first.half),
            self.to_match_half(second.half),
            first.half,
            F.pixel_shuffle(self.to_half(decoded), 2),
        )
        return Stages(
            correlation=correlation,
            scores=scores,
            coarse_px=coarse * 2,
            disparity_px=upsample_convex(fine * 2, weights.float()),
            confidence_logit=F.interpolate(confidence.float(), scale_factor=2.0, mode="bilinear"),
        )

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Left disparity, right disparity and the left view's confidence logit, each [B, 1, H, W]."""
        stages = self.stages(left, right)
        # At infinity noise goes both ways; a rectified pair of parallel cameras has nothing behind that.
        left_px, mirrored_right_px = stages.disparity_px.clamp(min=0).chunk(2)
        return left_px, mirrored(mirrored_right_px), stages.confidence_logit.chunk(2)[0]
