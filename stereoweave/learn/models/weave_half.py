"""WeaveNet at half the resolution of its images, with one more refinement at the full resolution."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.layers import HalveImage, mean_around, upsample_convex
from stereoweave.learn.models.weave import (
    BASE_GROWN,
    SMALL,
    CoarseStages,
    Refinement,
    WeaveNet,
    WeaveSize,
)

# Dilated convolutions have multiples of 16 channels: with others, oneDNN's gradients in bfloat16 may not be
# finite.
HALF = replace(
    BASE_GROWN,
    convolutions=(1, 4, 2, 2),
    context=64,
    propagation=32,
    compared=8,
    handed=7,
    warps=True,
    refinement=2,
    neighbours=4,
    wider=0,
)
# Training pairs reach 188 px. Pairs with surfaces beyond 250 px are matched better at a smaller size (lab
# notebook, 2026-11-27).
_RELIABLE_PX = 256
# Deviations from the local mean beyond this, in half-resolution pixels, all mean another surface.
_LARGEST_DEPARTURE = 8.0


class Enlargement(Refinement):
    """Refinement of the halved images' result, from which it takes confidence and edges as features."""

    def __init__(self) -> None:
        super().__init__(replace(SMALL, handed=3))

    def forward(
        self, disparity: Tensor, first: Tensor, second: Tensor, context: Tensor, confidence_logit: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return disparity in half-resolution pixels, upsampling weights and confidence logits.

        `first` and `second` are the features to correlate, from `as_matched_pixels`.
        """
        # A smaller window than in other stages, because this map is larger.
        departure = disparity - mean_around(disparity, 3)
        departure = departure.clamp(-_LARGEST_DEPARTURE, _LARGEST_DEPARTURE)
        # Scaled to the magnitude of other features.
        handed = torch.cat([departure, disparity / 32, confidence_logit / 4], 1)
        return super().forward(disparity, first, second, context, handed)


class WeaveHalfNet(WeaveNet):
    """WeaveNet for images of half the size, whose disparity is then refined and upsampled to the full size.

    With HALF it takes about as long as a WeaveNet of size SMALL. Its training can start from the weights of
    a WeaveNet.

    The sides of the images must be multiples of 32, or of 64 if `size` has a context at 1/32 resolution. Its
    levels reach twice as far as those of a WeaveNet; its range ends where training pairs make it reliable.

    Size, and cost for both views at 640x480: 761,602 parameters and 2.60 G multiply-adds with HALF.
    """

    def __init__(self, size: WeaveSize = HALF, levels: int = 48) -> None:
        super().__init__(size, levels)
        self.multiple_of *= 2
        half = SMALL.channels[0]
        self.stem = HalveImage(3, half, kernel=4)
        self.to_match_stem = nn.Conv2d(half, SMALL.compared, 1)
        self.enlargement = Enlargement()

    @property
    def max_disparity_px(self) -> int:
        return min(2 * super().max_disparity_px, _RELIABLE_PX)

    @property
    def refinements(self) -> tuple[Refinement, ...]:
        return (*super().refinements, self.enlargement)

    def estimate_coarse(self, left: Tensor, right: Tensor) -> CoarseStages:
        """Return both views' results for the halved images.

        Compared with a WeaveNet, matching scores are at 1/8 resolution, for each level of 8 px. The
        confidence for the halved images has no loss of its own.
        """
        inner = super().estimate_coarse(_halve(left), _halve(right))
        fine, confidence_logit, logits = self.refine_both(inner, self.refinement)
        stem = self.stem(torch.cat([left, right]))
        return replace(
            inner,
            disparity=self.upsample_coarse(fine * 2, logits),
            context=stem,
            match=self.to_match_stem(stem),
            handed=confidence_logit,
            upsampling_logits=(*inner.upsampling_logits, logits),
        )

    def upsample_coarse(self, x: Tensor, weights: Tensor) -> Tensor:
        """Upsample `x` by two with `weights`; surfaces are mixed at inference, too.

        Selecting one of them would amplify rounding errors twice as much, and later upsamplings amplify them
        again.
        """
        return upsample_convex(x, weights)


def _halve(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h2 w2"]:
    """Return the image at half its size, whose pixels are the means of 2x2 pixels.

    Bilinear interpolation gives the same, in a quarter of the time of ONNX Runtime's average. The size is
    given, not the scale: PyTorch's exporter writes every size after a scaling as a rounded fraction, and the
    export takes three times as long.
    """
    return F.interpolate(image, size=(image.shape[2] // 2, image.shape[3] // 2), mode="bilinear")
