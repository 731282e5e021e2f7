"""Variants of SMALL for the ablations, each a WeaveNet that differs from SMALL in one respect."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models import MODELS
from stereoweave.learn.models.layers import (
    ConvBlock,
    correlation_volume,
    local_soft_argmax,
    upsample_convex,
)
from stereoweave.learn.models.weave import (
    SMALL,
    Aggregation,
    WeaveFeatures,
    WeaveNet,
    as_matched_pixels,
)


def upsample_bilinear(x: Float[Tensor, "b 1 h w"], weights: Tensor) -> Float[Tensor, "b 1 h2 w2"]:
    """Enlarge maps to twice their size. The weights, which `upsample` uses in other networks, are ignored."""
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def soft_argmax(logits: Float[Tensor, "b d h w"]) -> Float[Tensor, "b 1 h w"]:
    """Return the expected level under a softmax over all levels (Kendall et al. 2017).

    At edges, this is a mixture of both surfaces.
    """
    levels = torch.arange(logits.shape[1], device=logits.device).view(1, -1, 1, 1)
    return (logits.softmax(1) * levels).sum(1, keepdim=True)


class NoWeights(nn.Module):
    """Placeholder for the upsampling weights that returns one map of zeros."""

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 h w"]:
        return torch.zeros_like(x[:, :1])


class BilinearWeaveNet(WeaveNet):
    """WeaveNet with bilinear upsampling instead of weights from the image."""

    upsample = staticmethod(upsample_bilinear)

    def __init__(self) -> None:
        super().__init__()
        self.register_module("weights", NoWeights())
        self.refinement.register_module("weights", NoWeights())


class AllLevelsWeaveNet(WeaveNet):
    """WeaveNet whose disparity is the expectation over all levels, not only those around the best level."""

    def read_disparity(self, scores: Tensor, decoded: Tensor) -> Tensor:
        return soft_argmax(scores)


class GroupedWeaveNet(WeaveNet):
    """WeaveNet with group-wise correlation (GwcNet, Guo et al. 2019), which scores groups of channels."""

    def __init__(self, groups: int = 4) -> None:
        super().__init__()
        self.groups = groups
        half, quarter, eighth, sixteenth = SMALL.channels
        wider = (half, quarter + (groups - 1) * self.levels, eighth, sixteenth)
        self.aggregation = Aggregation(self.levels, replace(SMALL, channels=wider))

    def match(self, maps: WeaveFeatures, first: WeaveFeatures) -> tuple[Tensor, Tensor, Tensor]:
        match = self.to_match(maps.quarter)
        batch = match.shape[0] // 2
        volumes = [
            correlation_volume(*as_matched_pixels(group, batch), self.levels)
            for group in match.chunk(self.groups, 1)
        ]
        correlation = torch.stack(volumes).sum(0)
        # The last group follows from the others and the sum of all.
        beside = first._replace(quarter=torch.cat([first.quarter, *volumes[:-1]], 1))
        return correlation, *self.aggregation(correlation, beside)


class EighthAggregation(Aggregation):
    """Aggregation of scores at 1/8 of the resolution, with a decoder that still ends at 1/4."""

    def __init__(self, levels: int) -> None:
        super().__init__(levels, SMALL)
        _, quarter, eighth, _ = SMALL.channels
        self.register_module("down", ConvBlock(levels, eighth))
        self.join = ConvBlock(SMALL.bottleneck + quarter, 32, kernel=1)
        self.scores = nn.Conv2d(32, levels, 2, stride=2)

    def forward(self, correlation: Tensor, features: WeaveFeatures) -> tuple[Tensor, Tensor]:
        dense = self.dense(torch.cat([self.down(correlation), features.eighth], 1))
        wide = self.bottleneck(dense) + self.context(dense, features.sixteenth)
        joined = self.join(torch.cat([F.interpolate(wide, scale_factor=2.0), features.quarter], 1))
        decoded = self.decode(joined)
        return correlation + self.scores(decoded), decoded


class EighthWeaveNet(WeaveNet):
    """WeaveNet with correlation at 1/8 of the resolution, over half as many levels of 8 px each."""

    def __init__(self) -> None:
        super().__init__(SMALL, levels=24)
        self.to_match = nn.Conv2d(SMALL.channels[2], 32, 1)
        self.aggregation = EighthAggregation(self.levels)
        self.weights_of_eighth = nn.Conv2d(32, 4 * SMALL.neighbours, 2, stride=2)

    @property
    def max_disparity_px(self) -> int:
        return 8 * self.levels

    def match(self, maps: WeaveFeatures, first: WeaveFeatures) -> tuple[Tensor, Tensor, Tensor]:
        return super().match(maps._replace(quarter=maps.eighth), first)

    def read_disparity(self, scores: Tensor, decoded: Tensor) -> Tensor:
        weights = self.weights_of_eighth(decoded).float()
        return upsample_convex(2 * local_soft_argmax(scores), weights)


class NoContext(nn.Module):
    """Placeholder for Context that returns zero."""

    def forward(self, dense: Tensor, sixteenth: Tensor) -> Tensor:
        return dense.new_zeros(())


class WeaveNetWithoutContext(WeaveNet):
    """WeaveNet whose aggregation lacks the context at 1/16 of the resolution."""

    def __init__(self) -> None:
        super().__init__()
        self.aggregation.register_module("context", NoContext())


VARIANTS: dict[str, Callable[[], WeaveNet]] = {
    "weave_small_eighth": EighthWeaveNet,
    "weave_small_grouped": GroupedWeaveNet,
    "weave_small_all_levels": AllLevelsWeaveNet,
    "weave_small_undilated": partial(WeaveNet, replace(SMALL, dilations=(1, 1, 1))),
    "weave_small_without_dense": partial(WeaveNet, replace(SMALL, dilations=())),
    "weave_small_without_context": WeaveNetWithoutContext,
    "weave_small_bilinear": BilinearWeaveNet,
    "weave_small_nine_neighbours": partial(WeaveNet, replace(SMALL, neighbours=9)),
    "weave_small_looked_up": partial(WeaveNet, replace(SMALL, warps=False, compared=16, handed=8)),
}


def register_variants() -> None:
    """Add the variants to MODELS, so that recipes and checkpoints can name them."""
    MODELS.update(VARIANTS)
