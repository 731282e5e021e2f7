"""Layers shared by the networks: convolution blocks, correlation, soft-argmax and guided upsampling."""

from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import pairwise
from operator import add
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor, nn

# Number of column blocks in a correlation. If the sides of the images are multiples of 16, the width at 1/4
# resolution is a multiple of four, so an exported graph needs no padding and has the same number of matrix
# products for any width.
_BLOCKS = 4
# Weight of a rejected neighbour. It avoids a division by zero if all neighbours are rejected; the result is
# then their mean.
_LEAST_SHARE = 1e-4


class ConvBlock(nn.Sequential):
    """Convolution, batch norm and ReLU at the input's resolution."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, dilation: int = 1) -> None:
        super().__init__(
            nn.Conv2d(
                inputs, outputs, kernel, padding=dilation * (kernel // 2), dilation=dilation, bias=False
            ),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class Halve(nn.Sequential):
    """Convolution, batch norm and ReLU at half the input's resolution.

    The kernel size is even, so that an output pixel is centred on the input pixels that it covers. A network
    that mirrors its feature maps needs such a symmetric grid.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int = 2) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride=2, padding=kernel // 2 - 1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class HalveImage(Halve):
    """`Halve` of an image whose values 0 .. 1 it maps to -1 .. 1.

    The weights are doubled instead of the image: the same bits, and one operation fewer on all its pixels.
    """

    def forward(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h2 w2"]:
        convolve, norm, relu = self
        assert isinstance(convolve, nn.Conv2d)
        halved = F.conv2d(image - 0.5, 2 * convolve.weight, stride=convolve.stride, padding=convolve.padding)
        return relu(norm(halved))


class Residual(nn.Module):
    """Residual block of two 3x3 convolutions, the first of which is dilated."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = ConvBlock(channels, channels, dilation=dilation)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return F.relu(x + self.second(self.first(x)))


Block = TypeVar("Block", Residual, nn.Conv2d)


def zero_initialise(block: Block) -> Block:
    """Zero the block's last layer, so that adding the block does not change a trained network's output."""
    last = block.second[1] if isinstance(block, Residual) else block
    for parameter in last.parameters():
        nn.init.zeros_(parameter)
    return block


class DilatedDense(nn.Module):
    """The paper's densely connected blocks of dilated convolutions.

    Each block reduces the number of channels of all previous maps, applies a dilated convolution, and appends
    the result.

    Deviation: batch norm and ReLU follow each convolution, while in the paper they precede it. Every batch
    norm can therefore be folded into its convolution on export.
    """

    def __init__(self, inputs: int, narrow: int, growth: int, dilations: tuple[int, ...]) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            nn.Sequential(
                ConvBlock(inputs + i * growth, narrow, kernel=1),
                ConvBlock(narrow, growth, dilation=dilation),
            )
            for i, dilation in enumerate(dilations)
        )
        self.outputs = inputs + growth * len(dilations)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c2 h w"]:
        for block in self.blocks:
            x = torch.cat([x, block(x)], 1)
        return x


def pixel_shuffle(x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c4 h2 w2"]:
    """Return PyTorch's `pixel_shuffle` by two: each new channel interleaves the pixels of four channels.

    Columns are interleaved first, then rows. ONNX Runtime takes half of the time of its DepthToSpace for one
    new channel, and as long for several.
    """
    batch, channels, height, width = x.shape
    columns = x.reshape(batch * channels // 2, 2, height * width).transpose(1, 2)
    rows = columns.reshape(batch * channels // 4, 2, height, 2 * width).transpose(1, 2)
    return rows.reshape(batch, channels // 4, 2 * height, 2 * width)


def mirror(x: Tensor, columns: int = 3) -> Tensor:
    """Flip the map left to right; `columns` is the axis of its columns."""
    return x.flip(columns)


def correlation_volume(
    first: Float[Tensor, "b h w c"], second: Float[Tensor, "b h w c"], levels: int
) -> Float[Tensor, "b d h w"]:
    """Correlate column x of `first` with column x - d of `second`, for d = 0 .. levels - 1.

    The correlation is 0 if column x - d is outside the map. Each matrix product compares a quarter of a row's
    columns with all columns that they can match. At 640x480 this takes half as many operations as comparing
    every column with every other. The plain reference is `correlation_volume_plain` in
    tests/learn/models/test_layers.py.
    """
    width = first.shape[2]
    if behind := -width % _BLOCKS:
        first, second = (F.pad(view, (0, 0, 0, behind)) for view in (first, second))
        return correlation_volume(first, second, levels)[..., :width]
    block = width // _BLOCKS
    # Column x - d of `second` is column x - d + levels - 1 of `others`.
    others = F.pad(second, (0, 0, levels - 1, 0))
    starts = [i * block for i in range(_BLOCKS)]
    products = [
        first[:, :, x : x + block] @ others[:, :, x : x + block + levels - 1].transpose(2, 3) for x in starts
    ]
    volume = torch.cat([_diagonals(product, levels) for product in products], 2)
    return volume.permute(0, 3, 1, 2).flip(1)


def _diagonals(products: Float[Tensor, "b h n m"], levels: int) -> Float[Tensor, "b h n d"]:
    """Move the element at [..., i, i + e] to [..., i, e], for e = 0 .. levels - 1, where levels is m - n + 1.

    Reading the same elements in rows that are one element longer turns diagonals into columns.
    """
    rows = products.shape[2]
    longer = torch.unflatten(F.pad(products.flatten(2), (0, rows)), 2, (rows, rows + levels))
    return longer[..., :levels]


def cost_volume(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], levels: int, stride: int = 1
) -> Float[Tensor, "b c2 d h w"]:
    """Concatenate the features of column x of `left` and column x - stride * d of `right`, d < levels.

    Right features are 0 if their column is outside the map. The plain reference is `cost_volume_plain` in
    tests/learn/models/test_layers.py.
    """
    farthest, width = stride * (levels - 1), right.shape[3]
    padded = F.pad(right, (farthest, 0))
    shifted = torch.stack([padded[..., x : x + width] for x in range(farthest, -1, -stride)], 2)
    return torch.cat([left.unsqueeze(2).expand_as(shifted), shifted], 1)


def soft_argmin(cost: Float[Tensor, "b d h w"]) -> Float[Tensor, "b 1 h w"]:
    """Return the expected disparity under a softmax over matching costs (Kendall et al. 2017).

    Args:
        cost: Matching cost per candidate [B, D, H, W]; lower costs are better. Candidate i is a disparity of
            i pixels at this resolution.

    Returns:
        Disparity [B, 1, H, W] in pixels: left column x corresponds to right column x - disparity.
    """
    candidates_px = torch.arange(cost.shape[1], dtype=cost.dtype, device=cost.device).view(1, -1, 1, 1)
    return ((-cost).softmax(1) * candidates_px).sum(1, keepdim=True)


def local_soft_argmax(logits: Float[Tensor, "b d h w"]) -> Float[Tensor, "b 1 h w"]:
    """Return the expected level under a softmax over the levels near the best one.

    Restricting the softmax to a window keeps a distant second candidate from pulling the mean off the
    surface. The window first covers 2 levels on each side of the best level. It is then centred on the mean
    three times, with weights that fade out over 3 levels. The result therefore hardly changes if rounding
    decides which of two levels is best.
    """
    best = logits.detach().argmax(1, keepdim=True)
    near, reach = 2, 3
    farthest = near + reach
    steps = torch.arange(-farthest, farthest + 1, device=logits.device).view(1, -1, 1, 1)
    # Levels beyond the ends of the volume are far less likely than any level inside it.
    padded = F.pad(logits, (0, 0, 0, 0, farthest, farthest), value=-1e4)
    around = padded.gather(1, best + steps + farthest)
    likelihood = (around - around.amax(1, keepdim=True)).exp()
    centre = expected_step(around[:, reach:-reach])
    for _ in range(3):
        weights = likelihood * (1 - (steps - centre.detach()).abs() / reach).clamp(min=0)
        centre = (weights * steps).sum(1, keepdim=True) / weights.sum(1, keepdim=True)
    return best + centre


def expected_step(logits: Float[Tensor, "b k h w"]) -> Float[Tensor, "b 1 h w"]:
    """Return the expected step, in -radius .. radius, under a softmax over the k = 2 * radius + 1 channels.

    The softmax is written out, because ONNX Runtime's own softmax over channels is ten times slower.
    """
    radius = logits.shape[1] // 2
    steps = torch.arange(-radius, radius + 1, device=logits.device).view(1, -1, 1, 1)
    weights = (logits - logits.amax(1, keepdim=True)).exp()
    return (weights * steps).sum(1, keepdim=True) / weights.sum(1, keepdim=True)


def correlate_nearby(
    first: Float[Tensor, "b h w c"],
    second: Float[Tensor, "b h w c"],
    disparity: Float[Tensor, "b 1 h w"],
    radius: int,
) -> Float[Tensor, "b k h w"]:
    """Correlate column x of `first` with column x - disparity - k of `second`, for k = -radius .. radius.

    The correlation is linearly interpolated between columns. Columns outside the map repeat the border
    column. The channels of a pixel are adjacent, so each lookup is one contiguous copy. Offsets are
    processed one at a time, which keeps gathered features in the processor's cache until they are summed.
    """
    batch, height, width, channels = first.shape
    whole = disparity.detach().floor()
    # In float32, because bfloat16 cannot represent the index of every column.
    columns = torch.arange(width, dtype=torch.float32, device=first.device) - whole
    left, pixels = first.reshape(-1, channels), second.reshape(-1, channels)
    products = []
    for step in range(-radius, radius + 2):
        found = pixels.index_select(0, _places(columns - step))
        products.append((left * found).sum(1).view(batch, 1, height, width))
    between = disparity.detach() - whole
    return torch.cat([near + between * (far - near) for near, far in pairwise(products)], 1)


def correlate_warped(
    first: Float[Tensor, "b h w c"],
    second: Float[Tensor, "b h w c"],
    disparity: Float[Tensor, "b 1 h w"],
    radius: int,
) -> Float[Tensor, "b k h w"]:
    """Correlate column x of `first` with column x - k of the warped `second`, for k = -radius .. radius.

    `second` is warped by `disparity`. On smooth surfaces the result equals that of `correlate_nearby`. It
    takes less time to compute, because only two columns per pixel are gathered for any radius. Columns
    outside the map repeat the border column. Outside the warped map, the correlation is 0.
    """
    batch, height, width, channels = first.shape
    columns = torch.arange(width, dtype=torch.float32, device=first.device) - disparity.detach()
    columns = columns.clamp(0, width - 1)
    below = columns.floor().clamp(0, width - 2)
    places = _places(below)
    pixels = second.reshape(-1, channels)
    low, high = pixels.index_select(0, places), pixels.index_select(0, places + 1)
    warped = low + (columns - below).view(-1, 1).to(low.dtype) * (high - low)
    warped = F.pad(warped.view(batch, height, width, channels), (0, 0, radius, radius))
    steps = range(2 * radius, -1, -1)
    return torch.cat(
        [(first * warped[:, :, x : x - 2 * radius or None]).sum(3).unsqueeze(1) for x in steps], 1
    )


def sample_at_match(
    other: Float[Tensor, "b 1 h w"], disparity: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 h w"]:
    """Sample the other view's map at column x - disparity, with linear interpolation and repeated borders."""
    width = other.shape[3]
    columns = torch.arange(width, dtype=torch.float32, device=other.device) - disparity.detach()
    columns = columns.clamp(0, width - 1)
    below = columns.floor().clamp(0, width - 2)
    place = below.long().clamp(0, width - 2)
    low, high = other.gather(3, place), other.gather(3, place + 1)
    return low + (columns - below) * (high - low)


def mean_around(x: Float[Tensor, "b c h w"], size: int) -> Float[Tensor, "b c h w"]:
    """Return the mean of the pixels of the map in the window of `size` x `size`, an odd number, around each.

    The means of rows are averaged over columns, which takes ONNX Runtime a fifth of the time of one average
    over the window.
    """
    reach = size // 2
    of_rows = F.avg_pool2d(x, (1, size), 1, (0, reach), count_include_pad=False)
    return F.avg_pool2d(of_rows, (size, 1), 1, (reach, 0), count_include_pad=False)


def gather_neighbours(
    x: Float[Tensor, "b 1 h w"], offsets: Sequence[tuple[int, int]]
) -> Float[Tensor, "b k h w"]:
    """Return the map's values at (row, column) offsets from each pixel; the border is repeated."""
    reach = max(abs(side) for offset in offsets for side in offset)
    around = F.pad(x, (reach, reach, reach, reach), mode="replicate")
    return torch.cat(
        [around[:, :, reach + y : y - reach or None, reach + x : x - reach or None] for y, x in offsets], 1
    )


def _places(columns: Float[Tensor, "b 1 h w"]) -> Int64[Tensor, " n"]:
    """Return the indices of the pixels in the given integer columns, each clamped to its own image row."""
    batch, _, height, width = columns.shape
    lines = torch.arange(batch * height, device=columns.device).view(batch, 1, height, 1)
    # Clamped as integers, so that a NaN disparity gives a NaN loss instead of an error here.
    return (columns.long().clamp(0, width - 1) + lines * width).view(-1)


def upsample_convex(
    x: Float[Tensor, "b 1 h w"], weights: Float[Tensor, "b k h w"]
) -> Float[Tensor, "b 1 h2 w2"]:
    """Upsample by two, making each new pixel a convex combination of old pixels (RAFT, Teed & Deng 2020).

    `weights` holds one logit for each combination of an old and a new pixel. If it is [B, 9 * 4, H, W], each
    new pixel combines the surrounding 3x3 old pixels; if it is [B, 4 * 4, H, W], it combines the 2x2 old
    pixels whose centres enclose it. The combination can place a sharp edge anywhere between two old pixels.

    Deviation: the weights are normalised sigmoids, because RAFT's softmax takes longer in ONNX Runtime than
    all convolutions together.
    """
    neighbours, logits = _neighbours(x, weights)
    shares = [logit.sigmoid() + _LEAST_SHARE for logit in logits]
    return pixel_shuffle(_weighted_sum(shares, neighbours) / _sum(shares))


def upsample_to_a_side(
    x: Float[Tensor, "b 1 h w"], weights: Float[Tensor, "b k h w"], step: float = 2.0
) -> Float[Tensor, "b 1 h2 w2"]:
    """Upsample like `upsample_convex`, but snap a mixture of two surfaces to the one with the larger share.

    The neighbours are split into those above and those below the mixture. They count as two surfaces if the
    means of the two sides are more than `step` apart. The mean of two surfaces lies on neither and would be a
    flying pixel. All thresholds are soft, so rounding errors cannot flip the result; a side with a share of
    at least three quarters is selected completely. The function is unsuitable for training, because the
    losing side gets hardly any gradient.
    """
    neighbours, logits = _neighbours(x, weights)
    # The sigmoid is written out, because ONNX Runtime's own has an error of 1e-7, which is too large where
    # all neighbours are rejected. The gradient of this form is NaN below a logit of -88, so training uses
    # PyTorch's sigmoid.
    shares = [(1 + (-logit).exp()).reciprocal() + _LEAST_SHARE for logit in logits]
    share, total = _sum(shares), _weighted_sum(shares, neighbours)
    mixed = total / share
    lowest = mixed - 0.5
    above = [
        part * (neighbour - lowest).clamp(0, 1) for part, neighbour in zip(shares, neighbours, strict=True)
    ]
    share_above, total_above = _sum(above), _weighted_sum(above, neighbours)
    # 1e-6 avoids a division by zero if one side is empty.
    mean_above = total_above / (share_above + 1e-6)
    mean_below = (total - total_above) / (share - share_above + 1e-6)
    belongs_above = (2 * share_above / share - 0.5).clamp(0, 1)
    side = mean_below + belongs_above * (mean_above - mean_below)
    apart = (mean_above - mean_below - step + 0.5).clamp(0, 1)
    return pixel_shuffle(mixed + apart * (side - mixed))


def _sum(maps: Iterable[Tensor]) -> Tensor:
    """Return the sum of the maps. ONNX Runtime adds them faster than it sums over an axis of one map."""
    return reduce(add, maps)


def _weighted_sum(shares: Sequence[Tensor], maps: Sequence[Tensor]) -> Tensor:
    return _sum(share * map_ for share, map_ in zip(shares, maps, strict=True))


def _neighbours(x: Tensor, weights: Tensor) -> tuple[list[Tensor], tuple[Tensor, ...]]:
    """Return a map for each old pixel around a new pixel, and one for the logits of its weights.

    The shapes are [B, 1, H, W] and [B, 4, H, W] for nine neighbours. For four neighbours, both shapes are
    [B, 4, H, W].
    """
    around = F.pad(x, (1, 1, 1, 1), mode="replicate")
    shifted = [around[:, :, dy : dy - 2 or None, dx : dx - 2 or None] for dy in range(3) for dx in range(3)]
    logits = weights.chunk(weights.shape[1] // 4, 1)
    if len(logits) == 9:
        return shifted, logits
    # Old pixel (a, b) of the enclosing 2x2, for new pixel (i, j) of the 2x2 that replace an old pixel.
    corners = [(0, 0), (0, 1), (1, 0), (1, 1)]
    return [torch.cat([shifted[3 * (i + a) + j + b] for i, j in corners], 1) for a, b in corners], logits


def pad_to_multiple(image: Float[Tensor, "b c h w"], multiple: int) -> Float[Tensor, "b c h2 w2"]:
    """Pad the image by repeating its last row and column until both sides are multiples of `multiple`.

    Padding is added below and on the right, so pixels keep their coordinates; crop results to
    [..., :height, :width]. An image that needs no padding is returned unchanged, so an exported graph whose
    sides are declared as multiples contains no padding.
    """
    below, behind = (-side % multiple for side in image.shape[2:])
    if below == behind == 0:
        return image
    return F.pad(image, (0, behind, 0, below), mode="replicate")


def predict_any_size(
    network: Any, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
) -> tuple[Float[Tensor, "b 1 h w"], ...]:
    """Return the maps of a network that takes views of certain sizes only, for views of any size."""
    height, width = left.shape[2:]
    padded = (pad_to_multiple(view, network.multiple_of) for view in (left, right))
    return tuple(map_[..., :height, :width] for map_ in network(*padded))


class NormReluConv(nn.Sequential):
    """Batch norm, ReLU and convolution, in this order, at the input's resolution."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 5, dilation: int = 1) -> None:
        super().__init__(
            keras_norm(inputs), nn.ReLU(inplace=True), same_conv(inputs, outputs, kernel, dilation)
        )


class PooledMatching(nn.Module):
    """DenseMapNet's correspondence network, which is also part of the paper's network.

    It matches the two views after stacking them and pooling by 8. Layers are registered in the order in which
    Keras numbers them in DenseMapNet's published weights.

    Args:
        channels: Number of channels per view.
    """

    def __init__(self, channels: int = 3) -> None:
        super().__init__()
        self.left_features = same_conv(channels, 16)
        self.left_channel = same_conv(channels, 1, dilation=2)
        self.stereo_features = same_conv(2 * channels, 32)
        self.norm = keras_norm(32)
        self.correspondence = nn.ModuleList(same_conv(32, 32, dilation=dilation) for dilation in (1, 2, 3, 4))
        self.dense = nn.ModuleList(
            nn.Sequential(NormReluConv(176 + 16 * i, 64, kernel=1), NormReluConv(64, 16, dilation=i + 1))
            for i in range(4)
        )
        self.bottleneck = NormReluConv(240, 32, kernel=1)
        self.dropout = nn.Dropout(0.2)

    def forward(
        self, left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b 32 h8 w8"], Float[Tensor, "b 16 h w"], Float[Tensor, "b 1 h w"]]:
        """Return the matches at 1/8 resolution, the left view's features, and its single-channel map."""
        features = self.left_features(left)
        stereo = self.stereo_features(torch.cat([left, right], 1))
        stereo = F.relu(self.norm(F.max_pool2d(stereo, 8)))
        # The widest dilation comes first, as in the channels of the published weights.
        found = [self.dropout(conv(stereo)) for conv in reversed(self.correspondence)]
        matches = torch.cat([F.max_pool2d(features, 8), *found, stereo], 1)
        for block in self.dense:
            matches = torch.cat([matches, self.dropout(block(matches))], 1)
        return self.bottleneck(matches), features, self.left_channel(left)


class CodeHead(nn.Module):
    """Head of DenseMapNet and of the paper's network; it predicts a code in 0..1.

    Its inputs are the decoded maps and the left view's single-channel map.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.conv = NormReluConv(inputs + 1, 16)
        self.norm = keras_norm(inputs + 1 + 16)
        self.to_code = nn.ConvTranspose2d(inputs + 1 + 16, 1, 9, padding=4)

    def forward(
        self, decoded: Float[Tensor, "b c h w"], left_channel: Float[Tensor, "b 1 h w"]
    ) -> Float[Tensor, "b 1 h w"]:
        joined = torch.cat([decoded, left_channel], 1)
        joined = torch.cat([joined, self.conv(joined)], 1)
        return self.to_code(F.relu(self.norm(joined))).sigmoid()


def same_conv(inputs: int, outputs: int, kernel: int = 5, dilation: int = 1) -> nn.Conv2d:
    """Build a convolution with bias at the input's resolution."""
    return nn.Conv2d(inputs, outputs, kernel, padding=dilation * (kernel // 2), dilation=dilation)


def keras_norm(channels: int) -> nn.BatchNorm2d:
    """Build a batch norm with Keras's default constants, as in DenseMapNet and the paper's network."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def initialise_as_keras(network: nn.Module) -> None:
    """Initialise every convolution with Glorot-uniform weights and zero biases, Keras's defaults.

    With PyTorch's default, a transposed convolution to one channel would start with weights more than twice
    as large. The logits of the following sigmoid would have a standard deviation of 2 instead of 0.8
    (measured).
    """
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.xavier_uniform_(layer.weight)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
