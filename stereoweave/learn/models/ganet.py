"""GA-Net: two of the authors' networks, GA-Net-11 and GA-Net-deep.

F. Zhang, V. Prisacariu, R. Yang and P. H. S. Torr, GA-Net: Guided Aggregation Net for End-to-end Stereo
Matching, CVPR 2019, arXiv:1904.06587. Two stacked hourglasses extract features at 1/3 of the resolution,
3-D convolutions and semi-global guided aggregation regularise a volume of matching costs, and local guided
aggregation refines it at full resolution. A guidance network predicts the weights of both aggregations.

The paper describes GA-Net-15 and names smaller ones by their number of 3-D convolutions. The authors' code
(github.com/feihuzhang/GANet, MIT licence) has GA-Net-11 and GA-Net-deep, and these are built here, layer by
layer. GA-Net-deep's code has 6,580,112 parameters, 6,560 of them in a layer that it never uses (`deconv0b`),
which is left out here. The paper's own counts, such as 2.3 M for GA-Net-15, are of the cost aggregation alone
(the authors' issue 66), so they cannot be compared.

Deviations, and choices where the paper is silent:

- The candidates are 3 px apart, from 0 to `max_disparity_px` rounded up to a multiple of 12, so that the
  volume can be halved twice. The authors' only range is 192.
- The feature extractor processes both views in one batch, so that both share the statistics of batch norm.
- Images are padded to multiples of 48 and the result is cropped. Colours are scaled to -1..1, because a batch
  norm follows; the authors normalise each view by its own mean and deviation.
- Upsampling treats pixels as areas (align_corners=False), as in the authors' code. This places level k of the
  costs, of features k columns apart, up to 1 px nearer to the middle of the range than 3 k px.
- The recursion of the semi-global aggregation and everything at full resolution are in float32.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.errors import StereoweaveError
from stereoweave.learn.models.guided_aggregation import (
    DIRECTIONS,
    LOCAL_WEIGHTS,
    SEMI_GLOBAL_WEIGHTS,
    aggregate_locally,
    aggregate_semi_globally,
)
from stereoweave.learn.models.layers import ConvBlock, cost_volume, pad_to_multiple, soft_argmin

# Factor by which the cost volume is smaller than the image, also in disparity.
_STEP = 3
# Images are padded to multiples of this, 16 times the step, inside the network.
_PADDED = 48
# Channels of the features from 1/3 to 1/48, and of the costs from 1/3 to 1/12.
_FEATURES = (32, 48, 64, 96, 128)
_COSTS = (32, 48, 64)


@dataclass(frozen=True, kw_only=True)
class GANetSize:
    """Size of a GA-Net.

    Attributes:
        hourglasses: Number of hourglasses over the costs.
        output_weights: Loss weight of each output: before, between and after the hourglasses.
    """

    hourglasses: int
    output_weights: tuple[float, ...]


GANET_11 = GANetSize(hourglasses=1, output_weights=(0.4, 1.2))
GANET_DEEP = GANetSize(hourglasses=2, output_weights=(0.2, 0.6, 1.0))


def normed(convolution: nn.Module, relu: bool = True) -> nn.Sequential:
    """Add a batch norm and, optionally, a ReLU to a convolution of images or volumes."""
    channels = convolution.out_channels
    assert isinstance(channels, int)
    volume = isinstance(convolution, nn.Conv3d | nn.ConvTranspose3d)
    norm = nn.BatchNorm3d(channels) if volume else nn.BatchNorm2d(channels)
    return nn.Sequential(convolution, norm, *([nn.ReLU(inplace=True)] if relu else []))


def image_convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    """Build a 3x3 convolution, or a 5x5 one with a stride of 3."""
    kernel = 5 if stride == _STEP else 3
    return nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False)


def volume_convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Conv3d:
    """Build a 3x3x3 convolution."""
    return nn.Conv3d(inputs, outputs, 3, stride, padding=1, bias=False)


class Join(nn.Module):
    """Maps at another resolution, joined with maps that already have it by a convolution.

    Args:
        resample: Convolution that changes the resolution.
        join: Convolution of both kinds of maps together.
        relu: Whether a ReLU ends the layer.
    """

    def __init__(self, resample: nn.Module, join: nn.Module, relu: bool = True) -> None:
        super().__init__()
        self.resample, self.join = normed(resample), normed(join, relu)

    def forward(self, x: Float[Tensor, "b c *size"], other: Float[Tensor, "b c2 *size2"]) -> Tensor:
        return self.join(torch.cat([self.resample(x), other], 1))


def expand_image(inputs: int, outputs: int) -> Join:
    """Build the layer that doubles the resolution of an image's maps."""
    resample = nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1, bias=False)
    return Join(resample, image_convolution(2 * outputs, outputs))


def expand_volume(inputs: int, outputs: int, relu: bool = True) -> Join:
    """Build the layer that doubles the resolution of a volume; 2 n + 1 levels come of n + 1."""
    resample = nn.ConvTranspose3d(inputs, outputs, (3, 4, 4), stride=2, padding=1, bias=False)
    return Join(resample, volume_convolution(2 * outputs, outputs), relu)


class GAFeatures(nn.Module):
    """Feature extractor of two stacked hourglasses, which returns maps [B, 32, H/3, W/3] of a view."""

    def __init__(self) -> None:
        super().__init__()
        self.start = nn.Sequential(
            normed(image_convolution(3, 32)),
            normed(image_convolution(32, 32, _STEP)),
            normed(image_convolution(32, 32)),
        )
        finer, coarser = _FEATURES[:-1], _FEATURES[1:]
        pairs = list(zip(finer, coarser, strict=True))
        self.down = nn.ModuleList(normed(image_convolution(few, many, 2)) for few, many in pairs)
        self.up = nn.ModuleList(expand_image(many, few) for few, many in pairs)
        self.down_again = nn.ModuleList(
            Join(image_convolution(few, many, 2), image_convolution(2 * many, many)) for few, many in pairs
        )
        self.up_again = nn.ModuleList(expand_image(many, few) for few, many in pairs)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 32 h3 w3"]:
        maps = [self.start(image * 2 - 1)]
        for down in self.down:
            maps.append(down(maps[-1]))
        _climb(self.up, maps)
        for level, down in enumerate(self.down_again, 1):
            maps[level] = down(maps[level - 1], maps[level])
        _climb(self.up_again, maps)
        return maps[0]


def _climb(ups: Sequence[nn.Module] | nn.ModuleList, maps: list[Tensor]) -> None:
    """Replace each level's maps, from the second coarsest to the finest, by a joint of it and the next."""
    for level in reversed(range(len(maps) - 1)):
        maps[level] = ups[level](maps[level + 1], maps[level])


class Guidance(nn.Module):
    """Network that predicts the weights of all aggregations from the left view and its features."""

    def __init__(self, size: GANetSize) -> None:
        super().__init__()
        self.image = nn.Sequential(normed(image_convolution(3, 16)), normed(image_convolution(16, 32)))
        self.features = image_convolution(32, 32)
        self.features_norm = nn.Sequential(nn.BatchNorm2d(32), nn.ReLU(inplace=True))
        self.start = ConvBlock(64, 16)
        thirds, sixths = size.hourglasses + 1, 2 * size.hourglasses
        first = nn.Sequential(normed(image_convolution(16, 32, _STEP)), ConvBlock(32, 32))
        halved = nn.Sequential(normed(image_convolution(32, 48, 2)), ConvBlock(48, 48))
        self.thirds = nn.ModuleList([first, *(ConvBlock(32, 32) for _ in range(thirds - 1))])
        self.sixths = nn.ModuleList([halved, *(ConvBlock(48, 48) for _ in range(sixths - 1))])
        self.third_weights = nn.ModuleList(_semi_global_weights(32) for _ in range(thirds))
        self.sixth_weights = nn.ModuleList(_semi_global_weights(48) for _ in range(sixths))
        self.local_weights = nn.ModuleList(
            nn.Sequential(ConvBlock(16, 16), image_convolution(16, LOCAL_WEIGHTS)) for _ in range(2)
        )

    def forward(
        self, image: Float[Tensor, "b 3 h w"], features: Float[Tensor, "b 32 h3 w3"]
    ) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Return the weights of the semi-global aggregations at 1/3 and at 1/6, and of the two local ones."""
        large = F.interpolate(self.features(features), scale_factor=float(_STEP), mode="bilinear")
        maps = self.start(torch.cat([self.image(image * 2 - 1), self.features_norm(large)], 1))
        local = [layer(maps) for layer in self.local_weights]
        found: list[list[Tensor]] = []
        for layers, heads in ((self.thirds, self.third_weights), (self.sixths, self.sixth_weights)):
            found.append([])
            for layer, head in zip(layers, heads, strict=True):
                maps = layer(maps)
                found[-1].append(head(maps))
        return found[0], found[1], local


def _semi_global_weights(channels: int) -> nn.Conv2d:
    return image_convolution(channels, DIRECTIONS * channels * SEMI_GLOBAL_WEIGHTS)


class SemiGlobal(nn.Module):
    """Semi-global guided aggregation and a 3-D convolution, whose result is added to the costs."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.Sequential(nn.BatchNorm3d(channels), nn.ReLU(inplace=True))
        self.refine = normed(volume_convolution(channels, channels), relu=False)

    def forward(
        self, costs: Float[Tensor, "b c d h w"], weights: Float[Tensor, "b k h w"]
    ) -> Float[Tensor, "b c d h w"]:
        return F.relu(costs + self.refine(self.norm(aggregate_semi_globally(costs, weights))))


class CostHourglass(nn.Module):
    """Hourglass over the costs, with semi-global aggregation on the way down at 1/6 and on the way up.

    Args:
        first: Whether the hourglass creates the maps at 1/6 and 1/12, or joins those of the one before.
    """

    def __init__(self, first: bool) -> None:
        super().__init__()
        pairs = list(zip(_COSTS[:-1], _COSTS[1:], strict=True))
        self.down = nn.ModuleList(
            normed(volume_convolution(few, many, 2))
            if first
            else Join(volume_convolution(few, many, 2), volume_convolution(2 * many, many))
            for few, many in pairs
        )
        self.up = nn.ModuleList(
            expand_volume(many, few, relu=level > 0) for level, (few, many) in enumerate(pairs)
        )
        self.aggregate_down, self.aggregate_up = SemiGlobal(48), SemiGlobal(48)
        self.aggregate_out = SemiGlobal(32)

    def forward(
        self, maps: Sequence[Tensor], third_weights: Tensor, sixth_weights: Sequence[Tensor]
    ) -> list[Tensor]:
        """Return the costs at 1/3, 1/6 and 1/12, given those at 1/3 alone or those of the one before."""
        third, *others = maps
        before: list[tuple[Tensor, ...]] = [(other,) for other in others] or [(), ()]
        sixth = self.aggregate_down(self.down[0](third, *before[0]), sixth_weights[0])
        twelfth = self.down[1](sixth, *before[1])
        sixth = self.aggregate_up(self.up[1](twelfth, sixth), sixth_weights[1])
        third = self.aggregate_out(self.up[0](sixth, third), third_weights)
        return [third, sixth, twelfth]


class GANet(nn.Module):
    """Network that estimates the left view's disparity as the mean of a distribution over candidates.

    GA-Net-11 has 4,483,728 parameters. GA-Net-deep has 6,573,552 parameters.

    Args:
        size: Size of the network.
        max_disparity_px: Largest candidate, rounded up to a multiple of 12.
    """

    # Crops need no multiple, because images are padded to 48; 16 is that of the paper's crops.
    multiple_of = 16
    predicts: ClassVar[Literal["code", "disparity_px"]] = "disparity_px"

    def __init__(self, size: GANetSize, max_disparity_px: int = 192) -> None:
        super().__init__()
        if max_disparity_px < 1:
            raise StereoweaveError(
                f"GANet: max_disparity_px: expected a positive whole number, found {max_disparity_px}"
            )
        self.output_weights = size.output_weights
        # One more than a multiple of 4, of which two halvings and two doublings make the same number.
        self.levels = 4 * -(-max_disparity_px // (4 * _STEP)) + 1
        self.features = GAFeatures()
        self.left_features, self.right_features = ConvBlock(32, 32), ConvBlock(32, 32)
        self.guidance = Guidance(size)
        self.narrow = normed(volume_convolution(64, 32), relu=False)
        self.aggregate = SemiGlobal(32)
        self.hourglasses = nn.ModuleList(CostHourglass(i == 0) for i in range(size.hourglasses))
        self.heads = nn.ModuleList(volume_convolution(32, 1) for _ in self.output_weights)
        self.apply(_initialise)

    def outputs(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"], ...]:
        """Return the disparity in pixels before and after each hourglass; the last one is the estimate."""
        volumes, local = self._volumes(left, right)
        costs = [self._full_costs(head(volume)) for head, volume in zip(self.heads, volumes, strict=True)]
        found = [*(soft_argmin(cost) for cost in costs[:-1]), _refined_disparity_px(costs[-1], local)]
        return tuple(disparity_px[..., : left.shape[2], : left.shape[3]] for disparity_px in found)

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b 1 h w"]:
        """Return the left view's disparity in pixels, given RGB images in 0..1."""
        volumes, local = self._volumes(left, right)
        costs = self._full_costs(self.heads[-1](volumes[-1]))
        return _refined_disparity_px(costs, local)[..., : left.shape[2], : left.shape[3]]

    def _volumes(self, left: Tensor, right: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Return the costs at 1/3 before, between and after the hourglasses, and the local weights."""
        views = pad_to_multiple(torch.cat([left, right]), _PADDED)
        batch = left.shape[0]
        features = self.features(views)
        thirds, sixths, local = self.guidance(views[:batch], features[:batch])
        costs = _masked_volume(
            self.left_features(features[:batch]), self.right_features(features[batch:]), self.levels
        )
        maps = [self.aggregate(self.narrow(costs), thirds[0])]
        volumes = list(maps)
        for i, hourglass in enumerate(self.hourglasses):
            maps = hourglass(maps, thirds[i + 1], sixths[2 * i : 2 * i + 2])
            volumes.append(maps[0])
        return volumes, local

    def _full_costs(self, costs: Float[Tensor, "b 1 d h w"]) -> Float[Tensor, "b d2 h2 w2"]:
        """Return the costs of the candidates 0, 1, ... px at full resolution."""
        _, _, levels, height, width = costs.shape
        size = (_STEP * (levels - 1) + 1, _STEP * height, _STEP * width)
        return F.interpolate(costs.float(), size, mode="trilinear").squeeze(1)


def _masked_volume(left: Tensor, right: Tensor, levels: int) -> Float[Tensor, "b c d h w"]:
    """Return the cost volume, all 0 where the candidate is outside the right image."""
    columns = torch.arange(left.shape[3], device=left.device)
    inside = columns >= torch.arange(levels, device=left.device).view(-1, 1, 1)
    return cost_volume(left, right, levels) * inside


def _refined_disparity_px(
    costs: Float[Tensor, "b d h w"], local: Sequence[Tensor]
) -> Float[Tensor, "b 1 h w"]:
    """Return the mean candidate after local aggregation, twice each of costs and of likelihoods."""
    before, after = local
    likelihood = (-aggregate_locally(costs, before, times=2)).softmax(1)
    likelihood = aggregate_locally(likelihood, after, times=2)
    candidates_px = torch.arange(costs.shape[1], dtype=costs.dtype, device=costs.device).view(1, -1, 1, 1)
    return (F.normalize(likelihood, p=1, dim=1) * candidates_px).sum(1, keepdim=True)


def _initialise(layer: nn.Module) -> None:
    """Draw weights from a normal distribution of variance 2 / (kernel volume * outputs), as in the code.

    Transposed convolutions keep PyTorch's default, as there.
    """
    if isinstance(layer, nn.Conv2d | nn.Conv3d):
        nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
