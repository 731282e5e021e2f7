"""FastDepthNet: the network of "Fast Depth Estimation for View Synthesis", section III-A.

It combines the matching of DenseMapNet (Atienza, "Fast Disparity Estimation Using Dense Networks", ICRA 2018)
with a decoder that upsamples in steps of two, each with a skip connection from the left view. Layers that
both networks use are in layers.py.

The paper gives the structure. Filter counts, elementwise dropout and the constants of batch norm are from the
published implementations, which also have 314,722 parameters. Choices where both sources are silent:

- Upsampling is by nearest neighbour, Keras's default.
- Weights are initialised by Glorot's method and biases to 0, Keras's defaults.
- Images whose sides are not multiples of 8 are padded below and on the right by repeating border pixels,
  and the result is cropped. Both views are padded alike and keep their origin, so disparities do not change.
"""

from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.layers import (
    CodeHead,
    NormReluConv,
    PooledMatching,
    initialise_as_keras,
    pad_to_multiple,
)


class FastDepthNet(nn.Module):
    """The paper's network. It predicts a code of depth or disparity in 0..1 for each left pixel.

    The network has 314,722 parameters and takes 7.39 G multiply-adds at 640x480.

    Args:
        skips: Whether each decoder step receives the left view's pooled features. The variant without these
            skip connections (301,858 parameters) tests the paper's claim about them.
    """

    multiple_of = 8
    predicts: ClassVar[Literal["code", "disparity_px"]] = "code"
    output_weights: ClassVar[tuple[float, ...]] = (1.0,)

    def __init__(self, skips: bool = True) -> None:
        super().__init__()
        self.skips = skips
        joined = 16 if skips else 0
        self.matching = PooledMatching()
        self.decode_quarter = NormReluConv(32 + joined, 16)
        self.decode_half = NormReluConv(16 + joined, 16)
        self.head = CodeHead(16)
        initialise_as_keras(self)

    def outputs(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"]]:
        """Return the code, the only supervised output."""
        height, width = left.shape[2:]
        left, right = (pad_to_multiple(view, self.multiple_of) for view in (left, right))
        matches, features, left_channel = self.matching(left, right)
        quarter = self.decode_quarter(self._enlarge(matches, features, 4))
        half = self.decode_half(self._enlarge(quarter, features, 2))
        code = self.head(F.interpolate(half, scale_factor=2.0), left_channel)
        return (code[..., :height, :width],)

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b 1 h w"]:
        """Return the left view's code [B, 1, H, W] in 0..1; nearer surfaces have higher codes.

        A `DepthCurve` converts the code to depth or disparity.

        Args:
            left: Left view [B, 3, H, W], RGB in 0..1, of any size.
            right: Right view, in the same format.
        """
        return self.outputs(left, right)[-1]

    def _enlarge(self, x: Tensor, features: Tensor, pool: int) -> Tensor:
        """Upsample by two, to 1/`pool` of full size, and append the left view's features if `skips`."""
        enlarged = F.interpolate(x, scale_factor=2.0)
        return torch.cat([enlarged, F.max_pool2d(features, pool)], 1) if self.skips else enlarged
