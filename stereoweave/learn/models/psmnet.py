"""PSMNet with the stacked hourglass.

J.-R. Chang and Y.-S. Chen, Pyramid Stereo Matching Network, CVPR 2018, arXiv:1803.08669.

Deviations, and choices where the paper is silent:

- The feature extractor processes both views in one batch. This is faster than two batches, gives the shared
  weights shared batch norm statistics, and allows batches of a single pair where pooling leaves one pixel per
  map.
- Pooling windows are limited to the size of the map, so that small crops can be used in training.
- The pyramid's branches have 1x1 kernels, as in the paper's text. With the 3x3 kernels in its table, the
  number of parameters would be 131,072 larger than published.
- Right features are 0 where the candidate is outside the right image; left features are kept.
- Colours are scaled to -1..1 rather than normalised with a dataset's mean and standard deviation, because a
  batch norm follows.
- Upsampling treats pixels as areas (align_corners=False). This places cost level k at candidate 4 k + 1.5,
  while the cost volume shifts level k by exactly 4 k px. A sharp minimum at level 10 therefore gives 41.5 px
  instead of 40 px. Training compensates for the 1.5 px except at the low end of the range, where the first
  two candidates always have equal costs. No estimate is therefore below 0.5 px, and disparities below about
  1.5 px are inaccurate.
"""

from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.errors import StereoweaveError
from stereoweave.learn.models.layers import ConvBlock, cost_volume, pad_to_multiple, soft_argmin


def norm_convolution(inputs: int, outputs: int, kernel: int, stride: int, dilation: int) -> nn.Sequential:
    """Build a convolution with the given stride and dilation, followed by a batch norm."""
    padding = dilation * (kernel // 2)
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, padding, dilation, bias=False), nn.BatchNorm2d(outputs)
    )


def norm_convolution_3d(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Build a 3x3x3 convolution with the given stride, followed by a batch norm."""
    return nn.Sequential(
        nn.Conv3d(inputs, outputs, 3, stride, padding=1, bias=False), nn.BatchNorm3d(outputs)
    )


def norm_expansion_3d(inputs: int, outputs: int) -> nn.Sequential:
    """Build a 3x3x3 transposed convolution that doubles the resolution, followed by a batch norm."""
    return nn.Sequential(
        nn.ConvTranspose3d(inputs, outputs, 3, stride=2, padding=1, output_padding=1, bias=False),
        nn.BatchNorm3d(outputs),
    )


class BasicBlock(nn.Module):
    """Residual block of two 3x3 convolutions, whose shortcut is a 1x1 convolution if the shape changes."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.body = nn.Sequential(
            norm_convolution(inputs, outputs, 3, stride, dilation),
            nn.ReLU(inplace=True),
            norm_convolution(outputs, outputs, 3, 1, dilation),
        )
        fits = inputs == outputs and stride == 1
        self.shortcut = nn.Identity() if fits else norm_convolution(inputs, outputs, 1, stride, 1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        return self.body(x) + self.shortcut(x)


def stack_basic_blocks(
    inputs: int, outputs: int, count: int, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    """Stack `count` basic blocks; the first block changes the number of channels and the resolution."""
    rest = (BasicBlock(outputs, outputs, dilation=dilation) for _ in range(count - 1))
    return nn.Sequential(BasicBlock(inputs, outputs, stride, dilation), *rest)


class PyramidPooling(nn.Module):
    """Mean pooling over windows of four sizes; each result has 32 channels and the input's resolution."""

    windows = (64, 32, 16, 8)

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList(ConvBlock(inputs, 32, kernel=1) for _ in self.windows)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 128 h w"]:
        height, width = x.shape[2:]
        pooled = (F.avg_pool2d(x, (min(window, height), min(window, width))) for window in self.windows)
        narrowed = (branch(mean) for branch, mean in zip(self.branches, pooled, strict=True))
        return torch.cat([F.interpolate(map_, (height, width), mode="bilinear") for map_ in narrowed], 1)


class PSMFeatures(nn.Module):
    """Feature extractor with multi-scale context, which returns maps [B, 32, H/4, W/4] of a view."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0 = nn.Sequential(
            norm_convolution(3, 32, 3, stride=2, dilation=1),
            nn.ReLU(inplace=True),
            ConvBlock(32, 32),
            ConvBlock(32, 32),
        )
        self.conv1 = stack_basic_blocks(32, 32, 3)
        self.conv2 = stack_basic_blocks(32, 64, 16, stride=2)
        self.conv3 = stack_basic_blocks(64, 128, 3, dilation=2)
        self.conv4 = stack_basic_blocks(128, 128, 3, dilation=4)
        self.pyramid = PyramidPooling(128)
        self.fusion = nn.Sequential(ConvBlock(64 + 128 + 128, 128), nn.Conv2d(128, 32, 1, bias=False))

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 32 h4 w4"]:
        conv2 = self.conv2(self.conv1(self.conv0(image * 2 - 1)))
        conv4 = self.conv4(self.conv3(conv2))
        return self.fusion(torch.cat([conv2, conv4, self.pyramid(conv4)], 1))


class Hourglass(nn.Module):
    """Encoder-decoder over the cost volume, down to a quarter of its resolution."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.Sequential(
            norm_convolution_3d(32, 64, stride=2), nn.ReLU(inplace=True), norm_convolution_3d(64, 64)
        )
        self.bottom = nn.Sequential(
            norm_convolution_3d(64, 64, stride=2),
            nn.ReLU(inplace=True),
            norm_convolution_3d(64, 64),
            nn.ReLU(inplace=True),
        )
        self.up = norm_expansion_3d(64, 64)
        self.out = norm_expansion_3d(64, 32)

    def forward(
        self,
        x: Float[Tensor, "b 32 d h w"],
        way_down: Float[Tensor, "b 64 d2 h2 w2"] | None,
        way_up: Float[Tensor, "b 64 d2 h2 w2"] | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return a correction to the volume [B, 32, D, H, W], the encoder's maps, and the decoder's maps.

        The maps of the encoder and the decoder are at half resolution. `way_down` holds the encoder's maps of
        the first hourglass, and `way_up` the decoder's maps of the previous hourglass. Both are None in the
        first hourglass.
        """
        down = self.down(x)
        here = F.relu(down if way_up is None else down + way_up)
        up = F.relu(self.up(self.bottom(here)) + (here if way_down is None else way_down))
        return self.out(up), here, up


class PSMNet(nn.Module):
    """Network that estimates the left view's disparity as the mean of a distribution over candidates.

    Estimates are between 0.5 px and `max_disparity_px` - 1.5 px. The network has 5,224,768 parameters and
    takes 432.88 G multiply-adds at 640x480 with 192 candidates. The multiply-adds include only convolutions,
    not batch norm, pooling, upsampling or softmax.

    Args:
        max_disparity_px: Number of candidate disparities, a multiple of 16.
    """

    multiple_of = 16
    predicts: ClassVar[Literal["code", "disparity_px"]] = "disparity_px"
    output_weights: ClassVar[tuple[float, ...]] = (0.5, 0.7, 1.0)

    def __init__(self, max_disparity_px: int = 192) -> None:
        super().__init__()
        if max_disparity_px < 16 or max_disparity_px % 16:
            raise StereoweaveError(
                f"PSMNet: max_disparity_px: expected a positive multiple of 16, found {max_disparity_px}"
            )
        self.max_disparity_px = max_disparity_px
        self.features = PSMFeatures()
        self.narrow = nn.Sequential(
            norm_convolution_3d(64, 32),
            nn.ReLU(inplace=True),
            norm_convolution_3d(32, 32),
            nn.ReLU(inplace=True),
        )
        self.residual = nn.Sequential(
            norm_convolution_3d(32, 32), nn.ReLU(inplace=True), norm_convolution_3d(32, 32)
        )
        self.hourglasses = nn.ModuleList(Hourglass() for _ in self.output_weights)
        self.heads = nn.ModuleList(_make_head() for _ in self.output_weights)
        self.apply(_initialise)

    def compute_costs(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> list[Float[Tensor, "b 1 d4 h4 w4"]]:
        """Return the matching costs after each hourglass, for every fourth candidate at 1/4 resolution."""
        views = pad_to_multiple(torch.cat([left, right]), self.multiple_of)
        left_features, right_features = self.features(views).chunk(2)
        narrowed = self.narrow(cost_volume(left_features, right_features, self.max_disparity_px // 4))
        volume = narrowed + self.residual(narrowed)
        costs: list[Tensor] = []
        maps, first_down, up = volume, None, None
        for hourglass, head in zip(self.hourglasses, self.heads, strict=True):
            correction, down, up = hourglass(maps, first_down, up)
            first_down = down if first_down is None else first_down
            maps = volume + correction
            costs.append(head(maps) + costs[-1] if costs else head(maps))
        return costs

    def outputs(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"], ...]:
        """Return the disparity in pixels after each hourglass; the last one is the estimate."""
        return tuple(_disparity_px(cost, left) for cost in self.compute_costs(left, right))

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b 1 h w"]:
        """Return the left view's disparity in pixels, given RGB images in 0..1."""
        return _disparity_px(self.compute_costs(left, right)[-1], left)


def _make_head() -> nn.Sequential:
    return nn.Sequential(
        norm_convolution_3d(32, 32), nn.ReLU(inplace=True), nn.Conv3d(32, 1, 3, padding=1, bias=False)
    )


def _disparity_px(
    cost: Float[Tensor, "b 1 d4 h4 w4"], image: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b 1 h w"]:
    """Return a disparity map of the same size as `image`, given costs at a quarter of the padded size.

    Level k of the costs is placed at candidate 4 k + 1.5, a deviation that the module's docstring explains.
    Costs of any type are converted to float32, because bfloat16 has no fractions between 128 and 256.
    """
    full = F.interpolate(cost.float(), scale_factor=4.0, mode="trilinear").squeeze(1)
    return soft_argmin(full)[..., : image.shape[2], : image.shape[3]]


def _initialise(layer: nn.Module) -> None:
    """Draw weights from a normal distribution of variance 2 / (kernel volume * outputs), as published."""
    if isinstance(layer, nn.Conv2d | nn.Conv3d):
        nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
    elif isinstance(layer, nn.ConvTranspose3d):
        # PyTorch transposes these weights, so its fan-in is the layer's fan-out.
        nn.init.kaiming_normal_(layer.weight, mode="fan_in", nonlinearity="relu")
