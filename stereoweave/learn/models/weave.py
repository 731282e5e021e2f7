"""WeaveNet: a correlation of encoder features, with the paper's dilated dense blocks and stepwise decoder.

The paper's network matches with convolutions over both views, stacked and pooled by 8. This ties the learned
matching to the training images. WeaveNet instead correlates the features that one encoder extracts from each
view. It keeps the paper's dilated, densely connected blocks, the decoder that upsamples in steps of two, and
the skip connections from the image.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.layers import (
    ConvBlock,
    DilatedDense,
    Halve,
    HalveImage,
    Residual,
    correlate_nearby,
    correlate_warped,
    correlation_volume,
    expected_step,
    local_soft_argmax,
    mean_around,
    mirror,
    pixel_shuffle,
    upsample_convex,
    upsample_to_a_side,
    zero_initialise,
)
from stereoweave.learn.models.weave_stages import Completion, WiderContext


@dataclass(frozen=True, kw_only=True)
class WeaveSize:
    """Layer sizes of a WeaveNet. Tuples of four hold the values for 1/2, 1/4, 1/8 and 1/16 resolution.

    Attributes:
        channels: Number of channels of the encoder's maps.
        convolutions: Number of the encoder's 3x3 convolutions at each resolution, besides the convolution
            that halves the resolution. Each pair of them forms a residual block.
        dilations: Dilations of the dense blocks at 1/8 resolution.
        growth: Number of channels that each dense block adds.
        bottleneck: Number of output channels of the dense blocks.
        context: Number of channels of the aggregation's context at 1/16 resolution.
        join_kernel: Kernel size of the encoder's last convolution.
        propagation: Number of channels of the blocks at 1/4 resolution that spread confident disparities; 0
            omits these blocks.
        compared: Number of channels that are correlated at 1/2 resolution.
        handed: Number of channels passed from the decoder to the refinement at 1/2 resolution. ONNX Runtime
            is faster if the refinement's number of input channels is a multiple of 4. BASE has 29, like the
            network from which it was grown.
        warps: Whether the other view is warped once for the correlation at 1/2 resolution, instead of being
            sampled for each offset.
        refinement: Number of 3x3 convolutions in the refinement at 1/2 resolution.
        neighbours: Number of low-resolution pixels that are combined into each upsampled pixel, 9 or 4.
        wider: Number of channels of the context at 1/32 resolution; 0 omits this context.
        completion: Number of channels of the stage at 1/4 resolution that completes occluded areas; 0 omits
            this stage.
    """

    channels: tuple[int, int, int, int]
    convolutions: tuple[int, int, int, int]
    dilations: tuple[int, ...]
    growth: int
    bottleneck: int
    context: int
    join_kernel: int
    propagation: int
    compared: int
    handed: int
    warps: bool
    refinement: int
    neighbours: int
    wider: int = 0
    completion: int = 0


SMALL = WeaveSize(
    channels=(16, 32, 48, 64),
    convolutions=(0, 1, 1, 1),
    dilations=(1, 2, 4),
    growth=16,
    bottleneck=32,
    context=48,
    join_kernel=1,
    propagation=0,
    compared=8,
    handed=7,
    warps=True,
    refinement=1,
    neighbours=4,
)
BASE = WeaveSize(
    channels=(16, 32, 64, 96),
    convolutions=(1, 4, 4, 4),
    dilations=(1, 2, 4, 8, 1),
    growth=32,
    bottleneck=48,
    context=96,
    join_kernel=3,
    propagation=48,
    compared=16,
    handed=8,
    warps=False,
    refinement=6,
    neighbours=9,
)

# BASE with all optional stages, which do not change its output until they are trained.
BASE_GROWN = replace(BASE, wider=64, completion=32)


@dataclass(frozen=True, kw_only=True)
class WeaveStages:
    """Results of every stage of a prediction, for use by the losses.

    The batch holds the left views first, then the mirrored right views.

    Attributes:
        correlation: Matching scores before aggregation, at 1/4 resolution, for each level of 4 px
            [2B, D, H/4, W/4]. In a `WeaveHalfNet` both numbers are 8.
        scores: Matching scores after aggregation, in the same format.
        coarse_px: Disparity before the refinement, at half resolution but in full-resolution pixels
            [2B, 1, H/2, W/2].
        disparity_px: Final disparity [2B, 1, H, W].
        confidence_logit: Log odds that the disparity is within 1 px of the truth [2B, 1, H, W].
        upsampling_logits: Logits of the weights of each upsampling: to 1/2 resolution [2B, K, H/4, W/4], and
            to full resolution [2B, K, H/2, W/2].
    """

    correlation: Float[Tensor, "b d h_d w_d"]
    scores: Float[Tensor, "b d h_d w_d"]
    coarse_px: Float[Tensor, "b 1 h2 w2"]
    disparity_px: Float[Tensor, "b 1 h w"]
    confidence_logit: Float[Tensor, "b 1 h w"]
    upsampling_logits: tuple[Tensor, ...]


@dataclass(frozen=True, kw_only=True)
class CoarseStages:
    """Results of the stages before the last refinement, which are its inputs.

    The batch holds the left views first, then the right views. The right views' maps are mirrored, except
    `context` and `match`.

    Attributes:
        correlation: As in `WeaveStages`.
        scores: As in `WeaveStages`.
        disparity: Disparity in half-resolution pixels [2B, 1, H/2, W/2].
        context: Features of the images [2B, C, H/2, W/2].
        match: Features to correlate [2B, C, H/2, W/2].
        handed: Maps that the refinement gets from the stages before it [2B, C, H/2, W/2].
        upsampling_logits: Logits of the weights of each upsampling so far.
    """

    correlation: Float[Tensor, "b d h_d w_d"]
    scores: Float[Tensor, "b d h_d w_d"]
    disparity: Float[Tensor, "b 1 h2 w2"]
    context: Float[Tensor, "b c1 h2 w2"]
    match: Float[Tensor, "b c2 h2 w2"]
    handed: Float[Tensor, "b c3 h2 w2"]
    upsampling_logits: tuple[Tensor, ...]


class WeaveFeatures(NamedTuple):
    """Feature maps of an image at 1/2, 1/4, 1/8 and 1/16 of its resolution."""

    half: Tensor
    quarter: Tensor
    eighth: Tensor
    sixteenth: Tensor


def as_left_view(views: Tensor, batch: int | torch.SymInt) -> Tensor:
    """Return the maps of the left views, then the mirrored maps of the right views."""
    return torch.cat([views[:batch], mirror(views[batch:])])


def as_matched_pixels(match: Tensor, batch: int | torch.SymInt) -> tuple[Tensor, Tensor]:
    """Return the features arranged as by `as_left_view`, and those that they are matched with.

    The latter are of the right views, then of the mirrored left views. Both are [2B, H, W, C]. ONNX Runtime
    mirrors maps faster in this order of pixels: it copies all channels of a pixel at once, and otherwise
    number by number.
    """
    pixels = match.permute(0, 2, 3, 1)
    left, right = pixels[:batch], pixels[batch:]
    return torch.cat([left, mirror(right, columns=2)]), torch.cat([right, mirror(left, columns=2)])


def stack_convolutions(channels: int, count: int) -> list[nn.Module]:
    """Build `count` 3x3 convolutions: a single one first if the count is odd, then residual blocks of two."""
    alone: list[nn.Module] = [ConvBlock(channels, channels)] * (count % 2)
    residual = [Residual(channels) for _ in range(count // 2)]
    return alone + residual[:1] + [zero_initialise(block) for block in residual[1:]]


class Encoder(nn.Module):
    """Feature encoder of one view.

    It downsamples to 1/16 resolution and upsamples again, so that finer maps include context.
    """

    def __init__(self, size: WeaveSize) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = size.channels
        counts = size.convolutions
        self.down_to_half = nn.Sequential(HalveImage(3, half, kernel=4), *stack_convolutions(half, counts[0]))
        self.down_to_quarter = nn.Sequential(Halve(half, quarter), *stack_convolutions(quarter, counts[1]))
        self.down_to_eighth = nn.Sequential(Halve(quarter, eighth), *stack_convolutions(eighth, counts[2]))
        self.down_to_sixteenth = nn.Sequential(
            Halve(eighth, sixteenth), *stack_convolutions(sixteenth, counts[3])
        )
        self.up_to_eighth = ConvBlock(sixteenth, eighth, kernel=1)
        self.up_to_quarter = ConvBlock(eighth, quarter, kernel=1)
        self.join = ConvBlock(quarter, quarter, kernel=size.join_kernel)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> WeaveFeatures:
        half = self.down_to_half(image)
        quarter = self.down_to_quarter(half)
        eighth = self.down_to_eighth(quarter)
        sixteenth = self.down_to_sixteenth(eighth)
        eighth = eighth + F.interpolate(self.up_to_eighth(sixteenth), scale_factor=2.0)
        quarter = quarter + F.interpolate(self.up_to_quarter(eighth), scale_factor=2.0)
        return WeaveFeatures(half, self.join(quarter), eighth, sixteenth)


class Context(nn.Module):
    """Context at 1/16 resolution, wide enough to reach the edges of textureless surfaces."""

    def __init__(self, inputs: int, sixteenth: int, size: WeaveSize) -> None:
        super().__init__()
        channels, outputs = size.context, size.bottleneck
        self.down = Halve(inputs, channels)
        self.join = ConvBlock(channels + sixteenth, channels, kernel=1)
        self.body = nn.Sequential(*(Residual(channels, dilation) for dilation in (2, 4)))
        self.wider = WiderContext(channels, size.wider) if size.wider else None
        self.up = zero_initialise(nn.Conv2d(channels, outputs, 1))

    def forward(self, dense: Tensor, sixteenth: Tensor) -> Tensor:
        wide = self.body(self.join(torch.cat([self.down(dense), sixteenth], 1)))
        if self.wider is not None:
            wide = self.wider(wide)
        return F.interpolate(self.up(wide), scale_factor=2.0)


class Aggregation(nn.Module):
    """Aggregation of matching scores by dilated dense blocks at 1/8 resolution, with a decoder to 1/4."""

    def __init__(self, levels: int, size: WeaveSize) -> None:
        super().__init__()
        _, quarter, eighth, sixteenth = size.channels
        self.down = Halve(levels + quarter, eighth)
        self.dense = DilatedDense(2 * eighth, narrow=32, growth=size.growth, dilations=size.dilations)
        self.bottleneck = ConvBlock(self.dense.outputs, size.bottleneck, kernel=1)
        self.context = Context(self.dense.outputs, sixteenth, size)
        self.join = ConvBlock(size.bottleneck + levels + quarter, 32, kernel=1)
        self.decode = ConvBlock(32, 32)
        self.scores = nn.Conv2d(32, levels, 1)

    def forward(self, correlation: Tensor, features: WeaveFeatures) -> tuple[Tensor, Tensor]:
        """Return the scores [B, D, H/4, W/4] and the decoder's features [B, 32, H/4, W/4]."""
        matches = torch.cat([correlation, features.quarter], 1)
        dense = self.dense(torch.cat([self.down(matches), features.eighth], 1))
        wide = self.bottleneck(dense) + self.context(dense, features.sixteenth)
        decoded = self.decode(self.join(torch.cat([F.interpolate(wide, scale_factor=2.0), matches], 1)))
        return correlation + self.scores(decoded), decoded


class Propagation(nn.Module):
    """Correction at 1/4 resolution that makes the disparity of smooth surfaces smoother.

    One of its inputs is the disparity's deviation from the local mean.
    """

    def __init__(self, quarter: int, channels: int) -> None:
        super().__init__()
        self.join = ConvBlock(32 + quarter + 2, channels, kernel=1)
        self.body = nn.Sequential(*(Residual(channels, dilation) for dilation in (1, 4)))
        self.correction = zero_initialise(nn.Conv2d(channels, 1, 1))
        self.decoded = zero_initialise(nn.Conv2d(channels, 32, 1))

    def forward(self, disparity: Tensor, quarter: Tensor, decoded: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corrected disparity in levels [B, 1, H/4, W/4] and the corrected decoder features."""
        # In float32, because near a disparity of 100 px bfloat16 cannot resolve the slope of a surface.
        departure = disparity - mean_around(disparity, 9)
        x = self.body(self.join(torch.cat([decoded, quarter, departure, disparity / 16], 1)))
        return disparity + self.correction(x).float(), decoded + self.decoded(x)


class Refinement(nn.Module):
    """Correction of the disparity by at most `radius` half-resolution pixels, from correlations around it."""

    def __init__(self, size: WeaveSize, radius: int = 2) -> None:
        super().__init__()
        self.radius = radius
        self.matches = correlate_warped if size.warps else correlate_nearby
        nearby = 2 * radius + 1
        # Multiply-adds of a pixel's matches, which are elementwise products. Without warping, they are
        # interpolated between one product more.
        self.products = size.compared * (nearby if size.warps else nearby + 1)
        self.join = ConvBlock(nearby + size.channels[0] + size.handed, 16, kernel=1)
        self.body = nn.Sequential(*stack_convolutions(16, size.refinement))
        self.scores = nn.Conv2d(16, nearby, 1)
        self.weights = nn.Conv2d(16, 4 * size.neighbours, 1)
        self.confidence = nn.Conv2d(16, 4, 1)

    def forward(
        self, disparity: Tensor, first: Tensor, second: Tensor, context: Tensor, decoded: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return disparity in half-resolution pixels, upsampling weights and confidence logits.

        `first` and `second` are the features to correlate, from `as_matched_pixels`.
        """
        matches = self.matches(first, second, disparity, self.radius)
        x = self.body(self.join(torch.cat([matches, context, decoded], 1)))
        correction = expected_step((matches + self.scores(x)).float())
        return disparity + correction, self.weights(x), pixel_shuffle(self.confidence(x))


class WeaveNet(nn.Module):
    """Network that estimates the disparity of both views of a rectified pair, and the left view's confidence.

    The sides of the images must be multiples of 16, or of 32 if there is a context at 1/32 resolution. The
    disparity range is 0 to `levels` * 4 - 1 px.

    Size, and cost for both views at 640x480:

    - SMALL: 278,029 parameters and 2.71 G multiply-adds
    - BASE: 1,274,290 parameters and 12.25 G multiply-adds
    - BASE_GROWN: 1,466,405 parameters and 12.86 G multiply-adds
    """

    def __init__(self, size: WeaveSize = SMALL, levels: int = 48) -> None:
        super().__init__()
        self.size, self.levels = size, levels
        self.multiple_of = 32 if size.wider else 16
        half, quarter = size.channels[:2]
        self.encoder = Encoder(size)
        self.to_match = nn.Conv2d(quarter, 32, 1)
        self.aggregation = Aggregation(levels, size)
        self.completion = Completion(quarter, size.completion) if size.completion else None
        self.propagation = Propagation(quarter, size.propagation) if size.propagation else None
        self.weights = nn.Conv2d(32, 4 * size.neighbours, 1)
        self.to_match_half = nn.Conv2d(half, size.compared, 1)
        self.to_half = nn.Conv2d(32, 4 * size.handed, 1)
        self.refinement = Refinement(size)

    @property
    def max_disparity_px(self) -> int:
        return 4 * self.levels

    @property
    def refinements(self) -> tuple[Refinement, ...]:
        """The refinements by matching, in order."""
        return (self.refinement,)

    def stages(self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]) -> WeaveStages:
        """Return the results of every stage for both views."""
        coarse = self.estimate_coarse(left, right)
        fine, confidence_logit, logits = self.refine_both(coarse, self.refinements[-1])
        return WeaveStages(
            correlation=coarse.correlation,
            scores=coarse.scores,
            coarse_px=coarse.disparity * 2,
            disparity_px=self.upsample(fine * 2, logits),
            confidence_logit=confidence_logit,
            upsampling_logits=(*coarse.upsampling_logits, logits),
        )

    def estimate_coarse(self, left: Tensor, right: Tensor) -> CoarseStages:
        """Return the results of both views before the last refinement."""
        # Here and below, len() and chunk() are avoided, because they would fix the batch size on export.
        batch = left.shape[0]
        maps = self.encoder(torch.cat([left, right]))
        # A mirrored right view is a left view, so one aggregation serves both.
        # The last refinement alone reads the map at 1/2 resolution, and arranges it itself.
        first = WeaveFeatures(maps.half, *(as_left_view(map_, batch) for map_ in maps[1:]))
        correlation, scores, decoded = self.match(maps, first)
        quarter = self.read_disparity(scores.float(), decoded)
        spread, decoded = self._propagate(quarter, first.quarter, decoded, batch)
        logits = self.weights(decoded).float()
        return CoarseStages(
            correlation=correlation,
            scores=scores,
            disparity=self.upsample_coarse(spread * 2, logits),
            context=maps.half,
            match=self.to_match_half(maps.half),
            handed=pixel_shuffle(self.to_half(decoded)),
            upsampling_logits=(logits,),
        )

    def refine_both(self, coarse: CoarseStages, refinement: Refinement) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `_refine` returns, for both views."""
        batch = coarse.match.shape[0] // 2
        context, match = as_left_view(coarse.context, batch), as_matched_pixels(coarse.match, batch)
        return self._refine(refinement, coarse.disparity, match, context, coarse.handed)

    def _refine(
        self,
        refinement: Refinement,
        disparity: Tensor,
        match: tuple[Tensor, Tensor],
        context: Tensor,
        handed: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return disparities in half-resolution pixels, confidence logits and upsampling logits.

        They are of the views whose maps are given. `match` holds the features of these views and of the other
        ones, each [B, H/2, W/2, C].
        """
        fine, logits, confidence = refinement(disparity, *match, context, handed)
        return fine, confidence.float(), logits.float()

    def match(self, maps: WeaveFeatures, first: WeaveFeatures) -> tuple[Tensor, Tensor, Tensor]:
        """Return the matching scores before and after aggregation, and the decoder's features.

        Args:
            maps: Features of the left views, then of the right views.
            first: The same features, arranged by `as_left_view`.
        """
        match = self.to_match(maps.quarter)
        batch = match.shape[0] // 2
        correlation = correlation_volume(*as_matched_pixels(match, batch), self.levels)
        return correlation, *self.aggregation(correlation, first)

    def upsample(self, x: Tensor, weights: Tensor) -> Tensor:
        """Upsample `x` by two with `weights`; edges are sharper at inference, when no gradient is needed."""
        return upsample_convex(x, weights) if self.training else upsample_to_a_side(x, weights)

    def upsample_coarse(self, x: Tensor, weights: Tensor) -> Tensor:
        """Upsample what the last refinement refines; subclasses may do it in another way than `upsample`."""
        return self.upsample(x, weights)

    def read_disparity(self, scores: Tensor, decoded: Tensor) -> Tensor:
        """Return the disparity in quarter-resolution pixels; subclasses may also use `decoded`."""
        return local_soft_argmax(scores)

    def _propagate(
        self, quarter: Tensor, features: Tensor, decoded: Tensor, batch: int | torch.SymInt
    ) -> tuple[Tensor, Tensor]:
        if self.completion is not None:
            # The other view's disparity, in that view's own columns.
            other = mirror(torch.cat([quarter[batch:], quarter[:batch]]))
            quarter, decoded = self.completion(quarter, other, features, decoded)
        if self.propagation is None:
            return quarter, decoded
        return self.propagation(quarter, features, decoded)

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return both views' disparities and the left view's confidence logit, each [B, 1, H, W].

        The right view's disparity, which serves the left-right check and new views, lacks the last
        refinement. That would take a tenth of BASE_GROWN's time, and a fifth of a `WeaveHalfNet`'s.
        """
        coarse, batch = self.estimate_coarse(left, right), left.shape[0]
        match = coarse.match.permute(0, 2, 3, 1)
        fine, confidence_logit, logits = self._refine(
            self.refinements[-1],
            coarse.disparity[:batch],
            (match[:batch], match[batch:]),
            coarse.context[:batch],
            coarse.handed[:batch],
        )
        left_px = self.upsample(fine * 2, logits)
        right_px = F.interpolate(mirror(coarse.disparity[batch:]) * 2, scale_factor=2.0)
        # Noise at infinity has both signs, but parallel cameras have no negative disparities.
        return left_px.clamp(min=0), right_px.clamp(min=0), confidence_logit
