"""SCV-Net.

C. Lu, H. Uchiyama, D. Thomas, A. Shimada and R. Taniguchi, Sparse Cost Volume for Efficient Stereo Matching,
Remote Sensing 10(11):1844, 2018. Features at half resolution are compared at every third shift only, which is
every 6 px: the sparse cost volume. The slices of the volume share a network of 2-D convolutions, an
hourglass of four halvings; each slice ends in the scores of its six disparities at full resolution. Weight
normalisation (Salimans and Kingma 2016) takes the place of batch norm.

The layers are those of the first author's code. Each has kernel area * inputs * outputs + outputs parameters,
and with weight normalisation another `outputs` for the lengths of the filters:

    first            25 *   3 *  32 +  32 +  32 =     2,464
    residual    16 * (9 *  32 *  32 +  32 +  32) =  148,480
    last              9 *  64 *  32 +  32       =    18,464
    1/2    15 *  64 *  32, 2 * 15 *  32 *  32   =    61,632
    1/4    25 *  64 *  64, 3 * 15 *  64 *  64   =   287,232
    1/8, 1/16                                  2 * 287,232
    1/32   25 *  64 * 128, 3 * 15 * 128 * 128   =   943,104
    expansions  15 * (128 + 64 + 64) * 64, 15 * 64 * 32 = 276,928
    scores           15 *  32 *   6 +   6       =     2,886
                                            sum 2,315,654

Deviations, and choices where the paper is silent:

- The number of slices follows the recipe's range: one for each 6 px, at 192 px the authors' 32. As in their
  code, the first slice drops its three scores below 0 px, and the last one ends 4 px below the range.
- The slices are processed in one batch, with the same result.
- The authors train with RMSprop and single pairs, without regard to the truth at 0 px. Here the loss, l1
  between disparities, is theirs; optimiser, batch and the use of all known truth are those of all recipes.
- Images are padded to multiples of 32 and the result is cropped. Colours are scaled to -1..1.
"""

from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from stereoweave.errors import StereoweaveError
from stereoweave.learn.models.layers import cost_volume, pad_to_multiple, soft_argmin

# Shift between two slices in features at half resolution, and in pixels.
STRIDE = 3
STRIDE_PX = 2 * STRIDE
# The scores of a slice begin this far below its own disparity.
_BELOW_PX = STRIDE_PX // 2
# Kernel of the convolutions on a slice: wider than high, because matches lie in the same row.
_WIDE = (3, 5)


def convolution(inputs: int, outputs: int, kernel: tuple[int, int], stride: int = 1) -> nn.Module:
    """Build a convolution with weight normalisation, whose filters each have a learned length."""
    padding = (kernel[0] // 2, kernel[1] // 2)
    return weight_norm(nn.Conv2d(inputs, outputs, kernel, stride, padding), dim=0)


def expansion(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    """Build a transposed convolution that doubles the resolution."""
    return nn.ConvTranspose2d(inputs, outputs, _WIDE, stride=2, padding=(1, 2), output_padding=1)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions, whose result is added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = convolution(channels, channels, (3, 3))
        self.second = convolution(channels, channels, (3, 3))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return F.relu(x + self.second(F.relu(self.first(x))))


class SCVFeatures(nn.Module):
    """Feature extractor, which returns maps [B, 32, H/2, W/2] of a view."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Sequential(convolution(3, 32, (5, 5), stride=2), nn.ReLU(inplace=True))
        self.early = nn.Sequential(*(ResidualBlock(32) for _ in range(3)))
        self.late = nn.Sequential(*(ResidualBlock(32) for _ in range(5)))
        self.last = nn.Conv2d(64, 32, 3, padding=1)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 32 h2 w2"]:
        early = self.early(self.first(image * 2 - 1))
        return self.last(torch.cat([early, self.late(early)], 1))


class SliceHourglass(nn.Module):
    """Scores of the six disparities of a slice, from its features."""

    def __init__(self) -> None:
        super().__init__()
        self.skip = _stack((64, 32, 32, 32))
        sizes = ((64, 64), (64, 64), (64, 64), (64, 128))
        self.halvings = nn.ModuleList(convolution(*size, (5, 5), stride=2) for size in sizes)
        self.skips = nn.ModuleList(_stack((channels,) * 4) for _, channels in sizes)
        wider = ((128, 64), (64, 64), (64, 64), (64, 32))
        self.expansions = nn.ModuleList(weight_norm(expansion(*size), dim=1) for size in wider)
        self.scores = expansion(32, STRIDE_PX)

    def forward(self, volume: Float[Tensor, "n 64 h w"]) -> Float[Tensor, "n 6 h2 w2"]:
        skipped = [self.skip(volume)]
        maps = volume
        for halve, skip in zip(self.halvings, self.skips, strict=True):
            maps = F.relu(halve(maps))
            skipped.append(skip(maps))
        maps = skipped.pop()
        for expand in self.expansions:
            maps = F.relu(skipped.pop() + expand(maps))
        return self.scores(maps)


class SCVNet(nn.Module):
    """Network that estimates the left view's disparity as the mean of a distribution over candidates.

    The network has 2,315,654 parameters.

    Args:
        max_disparity_px: End of the range, rounded up to a multiple of 6: at 192 px, candidates are 0 to 188.
    """

    multiple_of = 32
    predicts: ClassVar[Literal["code", "disparity_px"]] = "disparity_px"
    output_weights: ClassVar[tuple[float, ...]] = (1.0,)

    def __init__(self, max_disparity_px: int = 192) -> None:
        super().__init__()
        if max_disparity_px < 1:
            raise StereoweaveError(
                f"SCVNet: max_disparity_px: expected a positive whole number, found {max_disparity_px}"
            )
        self.slices = -(-max_disparity_px // STRIDE_PX)
        self.features = SCVFeatures()
        self.hourglass = SliceHourglass()

    def compute_scores(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b d h2 w2"]:
        """Return the score of each candidate disparity 0, 1, ... px, at the padded size; high is good."""
        views = pad_to_multiple(torch.cat([left, right]), self.multiple_of)
        features = self.features(views)
        batch = left.shape[0]  # not chunk(), which would fix the batch size on export
        volume = cost_volume(features[:batch], features[batch:], self.slices, STRIDE)
        scores = self.hourglass(volume.transpose(1, 2).flatten(0, 1))
        return scores.unflatten(0, (batch, self.slices)).flatten(1, 2)[:, _BELOW_PX:]

    def outputs(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"]]:
        """Return the disparity in pixels, the only supervised output."""
        # In float32, because bfloat16 has no fractions between 128 and 256.
        disparity_px = soft_argmin(-self.compute_scores(left, right).float())
        return (disparity_px[..., : left.shape[2], : left.shape[3]],)

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b 1 h w"]:
        """Return the left view's disparity in pixels, given RGB images in 0..1."""
        return self.outputs(left, right)[-1]


def _stack(channels: tuple[int, ...]) -> nn.Sequential:
    """Stack convolutions with the given numbers of channels, each followed by a ReLU."""
    layers: list[nn.Module] = []
    for inputs, outputs in zip(channels[:-1], channels[1:], strict=True):
        layers += [convolution(inputs, outputs, _WIDE), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)
