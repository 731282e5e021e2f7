"""DispNet with correlation along image rows (DispNetCorr1D).

N. Mayer et al., A Large Dataset to Train Convolutional Networks for Disparity, Optical Flow, and Scene Flow
Estimation, CVPR 2016, arXiv:1512.02134.

conv1 and conv2 process both views. The 105 input channels of conv3a are the correlations of 41 candidate
disparities and the 64 channels of conv_redir. Each layer has kernel area * inputs * outputs + outputs
parameters, where the numbers of input and output channels are from Table 1 of the paper:

    conv1     49 *    3 *   64 +   64 =     9,472
    conv2     25 *   64 *  128 +  128 =   204,928
    redirect   1 *  128 *   64 +   64 =     8,256
    conv3a    25 *  105 *  256 +  256 =   672,256
    conv3b     9 *  256 *  256 +  256 =   590,080
    conv4a     9 *  256 *  512 +  512 = 1,180,160
    conv4b     9 *  512 *  512 +  512 = 2,359,808
    conv5a     9 *  512 *  512 +  512 = 2,359,808
    conv5b     9 *  512 *  512 +  512 = 2,359,808
    conv6a     9 *  512 * 1024 + 1024 = 4,719,616
    conv6b     9 * 1024 * 1024 + 1024 = 9,438,208
    pr6        9 * 1024 *    1 +    1 =     9,217
    upconv5   16 * 1024 *  512 +  512 = 8,389,120    iconv5  9 * 1025 * 512 + 512 = 4,723,712    pr5  4,609
    upconv4   16 *  512 *  256 +  256 = 2,097,408    iconv4  9 *  769 * 256 + 256 = 1,772,032    pr4  2,305
    upconv3   16 *  256 *  128 +  128 =   524,416    iconv3  9 *  385 * 128 + 128 =   443,648    pr3  1,153
    upconv2   16 *  128 *   64 +   64 =   131,136    iconv2  9 *  193 *  64 +  64 =   111,232    pr2    577
    upconv1   16 *   64 *   32 +   32 =    32,800    iconv1  9 *   97 *  32 +  32 =    27,968    pr1    289
                                             sum 42,174,022

Deviations, and choices where the paper is silent:

- The paper starts with a loss on pr6 alone and shifts the weight to finer outputs during training. Here each
  output has a constant weight, which is half that of the next finer output. Every output is therefore trained
  from the first step, the final output weighs about as much as all the others together, and the network needs
  no schedule of its own.
- A prediction is upsampled bilinearly for the next iconv, because the table names no layer for this step.
- A leaky ReLU with a slope of 0.1 follows every convolution except the predictions.
- Colours are scaled to -1..1.
- Images are padded to multiples of 64, the stride of conv6, and the result is cropped to the original size.
"""

from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.learn.models.layers import correlation_volume, pad_to_multiple

SLOPE = 0.1
# The candidates are 0 to 40 px at 1/4 resolution, that is, 0 to 160 px at full resolution.
LEVELS = 41


def convolution(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Build a convolution with the given stride, followed by a leaky ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2), nn.LeakyReLU(SLOPE, inplace=True)
    )


def prediction(inputs: int) -> nn.Conv2d:
    """Build a convolution that predicts disparity in full-resolution pixels from `inputs` channels."""
    return nn.Conv2d(inputs, 1, 3, padding=1)


def mean_correlation(
    first: Float[Tensor, "b c h w"], second: Float[Tensor, "b c h w"]
) -> Float[Tensor, "b 41 h w"]:
    """Return the channel mean of column x of `first` times column x - d of `second`, for d = 0 .. 40."""
    volume = correlation_volume(first.permute(0, 2, 3, 1), second.permute(0, 2, 3, 1), LEVELS)
    return volume / first.shape[1]


def enlarge(map_: Float[Tensor, "b c h w"], scale: int) -> Float[Tensor, "b c h2 w2"]:
    """Upsample the map bilinearly by `scale`, without scaling its values."""
    return F.interpolate(map_, scale_factor=float(scale), mode="bilinear")


class Expansion(nn.Module):
    """Decoder step that doubles the resolution.

    `upconv` upsamples the maps, `iconv` combines them with the current disparity and the encoder's maps, and
    `prediction` returns the new disparity.
    """

    def __init__(self, inputs: int, skipped: int, outputs: int) -> None:
        super().__init__()
        self.upconv = nn.Sequential(
            nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1), nn.LeakyReLU(SLOPE, inplace=True)
        )
        self.iconv = convolution(outputs + 1 + skipped, outputs, 3)
        self.prediction = prediction(outputs)

    def forward(
        self,
        maps: Float[Tensor, "b c h w"],
        disparity_px: Float[Tensor, "b 1 h w"],
        skipped: Float[Tensor, "b c2 h2 w2"],
    ) -> tuple[Float[Tensor, "b c3 h2 w2"], Float[Tensor, "b 1 h2 w2"]]:
        """Return the new maps and the new disparity, both at twice the resolution of `maps`.

        The disparity is in full-resolution pixels.
        """
        maps = self.iconv(torch.cat([self.upconv(maps), enlarge(disparity_px, 2), skipped], 1))
        return maps, self.prediction(maps)


class DispNet(nn.Module):
    """Network that estimates the left view's disparity from correlations over a range of 160 px.

    The network has 42,174,022 parameters and takes 37.96 G multiply-adds at 640x480, padded to 640x512. The
    multiply-adds include the convolutions and the correlation, but not upsampling or activations.
    """

    multiple_of = 64
    predicts: ClassVar[Literal["code", "disparity_px"]] = "disparity_px"
    output_weights: ClassVar[tuple[float, ...]] = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = convolution(3, 64, 7, stride=2)
        self.conv2 = convolution(64, 128, 5, stride=2)
        self.redirect = convolution(128, 64, 1)
        self.conv3 = nn.Sequential(convolution(LEVELS + 64, 256, 5, stride=2), convolution(256, 256, 3))
        self.conv4 = nn.Sequential(convolution(256, 512, 3, stride=2), convolution(512, 512, 3))
        self.conv5 = nn.Sequential(convolution(512, 512, 3, stride=2), convolution(512, 512, 3))
        self.conv6 = nn.Sequential(convolution(512, 1024, 3, stride=2), convolution(1024, 1024, 3))
        self.prediction = prediction(1024)
        self.expansions = nn.ModuleList(
            Expansion(inputs, skipped, outputs)
            for inputs, skipped, outputs in [
                (1024, 512, 512),
                (512, 512, 256),
                (256, 256, 128),
                (128, 128, 64),
                (64, 64, 32),
            ]
        )
        self.apply(_initialise)

    def predictions(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> list[Float[Tensor, "b 1 _ _"]]:
        """Return the disparities pr6 to pr1 in full-resolution pixels, at 1/64 to 1/2 of the padded size."""
        views = pad_to_multiple(torch.cat([left, right]), self.multiple_of)
        half = self.conv1(views * 2 - 1)
        batch = left.shape[0]  # not chunk(), which would fix the batch size on export
        quarter = self.conv2(half)
        left_quarter, right_quarter = quarter[:batch], quarter[batch:]
        correlation = F.leaky_relu(mean_correlation(left_quarter, right_quarter), SLOPE)
        eighth = self.conv3(torch.cat([correlation, self.redirect(left_quarter)], 1))
        sixteenth = self.conv4(eighth)
        maps_32nd = self.conv5(sixteenth)
        maps = self.conv6(maps_32nd)
        predicted = [self.prediction(maps)]
        skips = maps_32nd, sixteenth, eighth, left_quarter, half[:batch]
        for expand, skipped in zip(self.expansions, skips, strict=True):
            maps, disparity_px = expand(maps, predicted[-1], skipped)
            predicted.append(disparity_px)
        return predicted

    def outputs(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"], ...]:
        """Return the disparities pr6 to pr1 in pixels, upsampled to full resolution; pr1 is the estimate."""
        height, width = left.shape[2:]
        return tuple(
            enlarge(disparity_px.float(), 64 >> level)[..., :height, :width]
            for level, disparity_px in enumerate(self.predictions(left, right))
        )

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b 1 h w"]:
        """Return the left view's disparity in pixels, given RGB images in 0..1."""
        return self.outputs(left, right)[-1]


def _initialise(layer: nn.Module) -> None:
    """Draw weights from a normal distribution of variance 2 / (1 + SLOPE^2) / terms (He et al. 2015).

    `terms` is the number of products that are summed for one output; a transposed convolution uses
    1 / stride^2 of its kernel for each output. As the network has no batch norm, only the initialisation
    preserves the signal's scale through 16 layers. PyTorch's default would lose about two thirds of the scale
    in each layer.
    """
    if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
        kernel, stride = layer.kernel_size[0], layer.stride[0] if layer.transposed else 1
        terms = layer.in_channels * (kernel / stride) ** 2
        nn.init.normal_(layer.weight, std=(2 / (1 + SLOPE**2) / terms) ** 0.5)
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
