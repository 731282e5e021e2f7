"""What the networks share: convolution blocks, correlation, soft-argmax, guided upsampling."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


class ConvBlock(nn.Sequential):
    """Convolution, batch norm, ReLU, at the resolution of the input."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, dilation: int = 1) -> None:
        super().__init__(
            nn.Conv2d(
                inputs, outputs, kernel, padding=dilation * (kernel // 2), dilation=dilation, bias=False
            ),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class Halve(nn.Sequential):
    """ConvBlock at half the resolution.

    The kernel is even, so that the centre of an output pixel is the centre of the pixels it stands for: a
    network that mirrors its feature maps needs maps whose grid is its own mirror image.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int = 2) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride=2, padding=kernel // 2 - 1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """Two 3x3 convolutions, the first one dilated, added to their input."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = ConvBlock(channels, channels, dilation=dilation)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return F.relu(x + self.second(self.first(x)))


class DilatedDense(nn.Module):
    """The paper's densely connected blocks: each narrows all maps so far, looks wider, and adds its own.

    Deviation: convolution, norm, ReLU in this order (the paper: norm, ReLU, convolution), so that every norm
    folds into its convolution when the network is exported.
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


def mirrored(x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """The map as a mirror shows it, left and right exchanged."""
    return x.flip(3)


def correlation_volume(
    first: Float[Tensor, "b c h w"], second: Float[Tensor, "b c h w"], levels: int
) -> Float[Tensor, "b d h w"]:
    """How well column x of `first` agrees with column x - d of `second`, for d = 0 .. levels - 1; 0 outside.

    One matrix product a row compares all columns with all columns; reading its result with rows one element
    shorter turns the diagonals that are wanted into columns. Plain reference: `correlation_volume_plain` in
    tests/test_layers.py.
    """
    width = first.shape[3]
    products = first.permute(0, 2, 3, 1) @ mirrored(second).permute(0, 2, 1, 3)
    padded = F.pad(products, (0, levels))
    skewed = torch.unflatten(padded.flatten(2)[..., width - 1 : -1], 2, (width, width + levels - 1))
    return skewed[..., :levels].permute(0, 3, 1, 2)


def local_soft_argmax(logits: Float[Tensor, "b d h w"]) -> Float[Tensor, "b 1 h w"]:
    """Expected level under a softmax over the surroundings of the best level.

    The window keeps a second, far-off candidate from pulling the mean off the surface. First it reaches 2
    levels to each side of the best one; then it moves to the mean found there, fading out over 3 levels, so
    that the result hardly jumps where rounding decides which of two levels is the best.
    """
    best = logits.detach().argmax(1, keepdim=True)
    reach = 3
    steps = torch.arange(-reach, reach + 1, device=logits.device).view(1, -1, 1, 1)
    # A level beyond the volume's ends: far less likely than any inside it.
    padded = F.pad(logits, (0, 0, 0, 0, reach, reach), value=-1e4)
    around = padded.gather(1, best + steps + reach)
    centre = expected_step(around[:, 1:-1]).detach()
    fade = (1 - (steps - centre).abs() / reach).clamp(min=0)
    weights = (around - around.amax(1, keepdim=True)).exp() * fade
    return best + (weights * steps).sum(1, keepdim=True) / weights.sum(1, keepdim=True)


def expected_step(logits: Float[Tensor, "b k h w"]) -> Float[Tensor, "b 1 h w"]:
    """Expectation of -radius .. radius under a softmax over channels, k = 2 * radius + 1.

    Written out, because ONNX Runtime's softmax over channels is ten times slower than these steps.
    """
    radius = logits.shape[1] // 2
    steps = torch.arange(-radius, radius + 1, device=logits.device).view(1, -1, 1, 1)
    weights = (logits - logits.amax(1, keepdim=True)).exp()
    return (weights * steps).sum(1, keepdim=True) / weights.sum(1, keepdim=True)


def nearby_matches(
    first: Float[Tensor, "b c h w"],
    second: Float[Tensor, "b c h w"],
    disparity: Float[Tensor, "b 1 h w"],
    radius: int,
) -> Float[Tensor, "b k h w"]:
    """Correlation of column x of `first` with column x - disparity - k of `second`, k = -radius .. radius.

    Between two columns it is interpolated; columns outside the map count as its border.
    """
    batch, channels, height, width = first.shape
    whole = disparity.detach().floor()
    steps = torch.arange(-radius, radius + 2, device=first.device)
    columns = torch.arange(width, device=first.device).view(1, 1, width, 1)
    rows = torch.arange(batch * height, device=first.device).view(batch, height, 1, 1)
    matched = columns - whole.long().view(batch, height, width, 1) - steps
    # One row of `pixels` is one pixel's features, so that looking one up is one contiguous copy.
    pixels = second.permute(0, 2, 3, 1).reshape(-1, channels)
    found = pixels.index_select(0, (matched.clamp(0, width - 1) + rows * width).view(-1))
    found = found.view(batch, height, width, 2 * radius + 2, channels)
    matches = (found * first.permute(0, 2, 3, 1).unsqueeze(3)).sum(4).permute(0, 3, 1, 2)
    between = disparity.detach() - whole
    return matches[:, :-1] + between * (matches[:, 1:] - matches[:, :-1])


def warped_matches(
    first: Float[Tensor, "b c h w"],
    second: Float[Tensor, "b c h w"],
    disparity: Float[Tensor, "b 1 h w"],
    radius: int,
) -> Float[Tensor, "b k h w"]:
    """Correlation of column x of `first` with column x - k of `second` warped by `disparity`, k = -radius .. radius.

    Where the surface is smooth this is `nearby_matches` at a third of its cost: two columns are looked up
    for each pixel, whatever the radius. Columns outside the map count as its border; beyond the warped map
    there is nothing, 0.
    """
    batch, channels, height, width = first.shape
    columns = torch.arange(width, device=first.device).view(1, 1, 1, width) - disparity.detach()
    below = columns.clamp(0, width - 1).floor().clamp(max=width - 2)
    between = (columns.clamp(0, width - 1) - below).view(batch, height, width, 1)
    rows = torch.arange(batch * height, dtype=torch.int32, device=first.device) * width
    places = (below.to(torch.int32) + rows.view(batch, 1, height, 1)).view(-1)
    # One row of `pixels` is one pixel's features, so that looking one up is one contiguous copy.
    pixels = second.permute(0, 2, 3, 1).reshape(-1, channels)
    low, high = (pixels.index_select(0, places + i).view(batch, height, width, channels) for i in (0, 1))
    warped = F.pad(low + between * (high - low), (0, 0, radius, radius))
    left = first.permute(0, 2, 3, 1)
    steps = range(2 * radius, -1, -1)
    matches = [(left * warped[:, :, step : step + width]).sum(3, keepdim=True) for step in steps]
    return torch.cat(matches, 3).permute(0, 3, 1, 2)


def upsample_convex(
    x: Float[Tensor, "b 1 h w"], weights: Float[Tensor, "b k h w"]
) -> Float[Tensor, "b 1 h2 w2"]:
    """Twice the size: each new pixel a convex mixture of old ones around it (RAFT, Teed & Deng 2020).

    `weights` are logits, one for each of the old pixels and each of the four new ones: [B, 9 * 4, H, W] mixes
    the 3x3 old pixels around, [B, 4 * 4, H, W] the 2x2 between whose centres the new one lies. A mixture
    can put an edge anywhere between two old pixels without inventing values between its two sides.

    Deviation: shares of sigmoids; RAFT's softmax costs ONNX Runtime more than all convolutions.
    """
    batch, channels, height, width = weights.shape
    around = F.pad(x, (1, 1, 1, 1), mode="replicate")
    shifted = [around[:, :, dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)]
    if channels == 9 * 4:
        neighbours = torch.stack(shifted, 1)
    else:
        # Of old pixel (a, b) among the four, for new pixel (i, j) among the four.
        corners = [(0, 0), (0, 1), (1, 0), (1, 1)]
        neighbours = torch.cat([shifted[3 * (i + a) + j + b] for a, b in corners for i, j in corners], 1)
        neighbours = neighbours.view(batch, 4, 4, height, width)
    shares = weights.contiguous().view(batch, channels // 4, 4, height, width).sigmoid()
    # 1e-4: where all are refused, no division by zero, and still a mixture of nothing but neighbours.
    mixed = ((shares + 1e-4) * neighbours).sum(1) / (shares + 1e-4).sum(1)
    return F.pixel_shuffle(mixed, 2)


def pad_to_multiple(image: Float[Tensor, "b c h w"], multiple: int) -> Float[Tensor, "b c h2 w2"]:
    """The image with its last row and column repeated until both sides are multiples of `multiple`.

    Everything is added below and on the right, so that a pixel keeps its place: a result is cut back to
    [..., :height, :width]. An image that already fits comes back itself, and an exported graph whose sides
    are declared as multiples holds no padding.
    """
    below, behind = (-side % multiple for side in image.shape[2:])
    if below == behind == 0:
        return image
    return F.pad(image, (0, behind, 0, below), mode="replicate")


class NormReluConv(nn.Sequential):
    """Batch norm, ReLU, convolution, in the order of DenseMapNet and the paper; the resolution stays."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 5, dilation: int = 1) -> None:
        super().__init__(
            keras_norm(inputs), nn.ReLU(inplace=True), same_conv(inputs, outputs, kernel, dilation)
        )


class PooledMatching(nn.Module):
    """DenseMapNet's correspondence network, which the paper takes over: both views in one map, pooled by 8.

    Layers are registered in the order in which Keras numbers them in DenseMapNet's published weights.

    Args:
        channels: Channels of one view.
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
        """Matches at 1/8 resolution; the left view's features at full resolution, and one channel of it."""
        features = self.left_features(left)
        stereo = self.stereo_features(torch.cat([left, right], 1))
        stereo = F.relu(self.norm(F.max_pool2d(stereo, 8)))
        # The widest dilation first: the published weights want the channels in this order.
        found = [self.dropout(conv(stereo)) for conv in reversed(self.correspondence)]
        matches = torch.cat([F.max_pool2d(features, 8), *found, stereo], 1)
        for block in self.dense:
            matches = torch.cat([matches, self.dropout(block(matches))], 1)
        return self.bottleneck(matches), features, self.left_channel(left)


class CodeHead(nn.Module):
    """The last layers of DenseMapNet and the paper: a code in 0..1 from decoded maps and the left channel."""

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
    """A convolution with bias that keeps the resolution."""
    return nn.Conv2d(inputs, outputs, kernel, padding=dilation * (kernel // 2), dilation=dilation)


def keras_norm(channels: int) -> nn.BatchNorm2d:
    """Batch norm with Keras's defaults, under which DenseMapNet and the paper's network were published."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def initialise_as_keras(network: nn.Module) -> None:
    """Give every convolution Glorot's uniform weights and no bias, Keras's defaults.

    PyTorch's own would start a transposed convolution to one channel with weights more than twice as large:
    the sigmoid behind it would see logits with a standard deviation of 2 in place of 0.8 (measured).
    """
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.xavier_uniform_(layer.weight)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
