"""MC-CNN, the fast architecture of J. Zbontar and Y. LeCun (JMLR 2016).

The paper is "Stereo Matching by Training a Convolutional Neural Network to Compare Image Patches"; its
section 3.1 has the network. One stack of convolutions turns each 11x11 patch into a vector of unit length;
two patches are as similar as the dot product of their vectors. `bench/mc_cnn` finds disparities from them.
The parameters have the names of the published PyTorch weights (github.com/CNES/Pandora_MCCNN, Apache-2.0),
which `load_weights` reads.
"""

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.errors import FormatError, reason

CHANNELS = 64
_LAYERS = 5
PATCH_PX = 2 * _LAYERS + 1
"""Side of the patch that a vector describes."""
# Entries of a PyTorch file that may hold the weights: of the published files, and of our checkpoints.
_ENTRIES = ("model", "averaged")


class MCCNN(nn.Module):
    """Network that describes the surroundings of each pixel by 64 numbers.

    The network has 148,352 parameters and takes 45.48 G multiply-adds for a view of 640x480.
    """

    multiple_of = 1

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs in (1, *[CHANNELS] * (_LAYERS - 1)):
            layers += [nn.Conv2d(inputs, CHANNELS, 3, padding=1), nn.ReLU()]
        self.conv_blocks = nn.Sequential(*layers[:-1])

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b c h w"]]:
        """Return the vectors of both views [B, 64, H, W], of unit length.

        Args:
            left: Left view [B, 3, H, W], RGB in 0..1, of any size.
            right: Right view, in the same format.
        """
        return self.describe(standardise(left)), self.describe(standardise(right))

    def describe(self, grey: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h w"]:
        """Return each pixel's vector [B, 64, H, W]; beyond the borders, every layer sees zeros."""
        return F.normalize(self.conv_blocks(grey).float(), dim=1)

    def describe_patches(self, patches: Float[Tensor, "n 1 s s"]) -> Float[Tensor, "n c"]:
        """Return a vector [N, 64] for each patch [N, 1, 11, 11]; no layer is padded."""
        for layer in self.conv_blocks:
            if isinstance(layer, nn.Conv2d):
                patches = F.conv2d(patches, layer.weight, layer.bias)
            else:
                patches = layer(patches)
        return F.normalize(patches.float().flatten(1), dim=1)


def standardise(view: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
    """Return grey levels (Rec. 601) with mean 0 and standard deviation 1 in each view; 0 in a plain view.

    Grey is rounded to whole levels of 0..255, as OpenCV does: what is known of the published weights was
    measured on such levels.
    """
    red, green, blue = view.float().chunk(3, 1)
    levels = (255 * (0.299 * red + 0.587 * green + 0.114 * blue)).round()
    centred = levels - levels.mean((2, 3), keepdim=True)
    # At least a tenth of a level, so that rounding errors of a plain view's mean stay small.
    return centred / centred.square().mean((2, 3), keepdim=True).sqrt().clamp(min=0.1)


def load_weights(path: str | Path) -> MCCNN:
    """Load a published network, or the averaged weights of a checkpoint. Returns it in eval mode.

    Raises:
        FormatError: The file is missing or not PyTorch's, or its layers, shapes or values are not MC-CNN's.
    """
    network, found = MCCNN(), _read_tensors(path)
    for name, values in network.state_dict().items():
        if name not in found:
            raise FormatError(f"{path}: expected MC-CNN's weights, found no {name}")
        theirs = found.pop(name)
        if not isinstance(theirs, Tensor) or theirs.shape != values.shape:
            shape = tuple(theirs.shape) if isinstance(theirs, Tensor) else type(theirs).__name__
            raise FormatError(f"{path}: expected {name} of shape {tuple(values.shape)}, found {shape}")
        if not (theirs.is_floating_point() and theirs.isfinite().all()):
            raise FormatError(f"{path}: expected finite numbers in {name}, found others")
        values.copy_(theirs)
    if found:
        raise FormatError(f"{path}: expected only MC-CNN's weights, also found {min(map(str, found))}")
    return network.eval()


def _read_tensors(path: str | Path) -> dict[Any, Any]:
    """Read the entry of a PyTorch file that holds the weights. No code from the file is run."""
    try:
        values = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise FormatError(f"{path}: expected MC-CNN's weights, found no such file") from error
    except Exception as error:  # PyTorch's reader raises any type of error on invalid bytes
        found = reason(error) if isinstance(error, OSError) else "another kind of file, or a damaged one"
        raise FormatError(f"{path}: expected MC-CNN's weights in a PyTorch file, found {found}") from error
    for entry in _ENTRIES:
        if isinstance(values, dict) and isinstance(values.get(entry), dict):
            return dict(values[entry])
    raise FormatError(
        f"{path}: expected MC-CNN's weights in an entry {' or '.join(_ENTRIES)}, found neither; published "
        f"files are in github.com/CNES/Pandora_MCCNN"
    )
