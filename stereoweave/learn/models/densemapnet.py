"""DenseMapNet: R. Atienza, "Fast Disparity Estimation Using Dense Networks", ICRA 2018.

It is the predecessor of the paper's network. Both networks match the two views after stacking them and
pooling by 8. DenseMapNet then upsamples the result by 8 in one step. Layers that both networks use are in
layers.py. The layers match the published weights (github.com/roatienza/densemapnet, MIT licence), which
`load_keras` reads.

Deviation: images whose sides are not multiples of 8 are padded below and on the right by repeating border
pixels, and the result is cropped. The published code zero-pads its feature maps instead.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.errors import FormatError
from stereoweave.learn.models.layers import CodeHead, PooledMatching, initialise_as_keras, pad_to_multiple

# Name of each layer type in a Keras file, and the Keras names of its tensors.
_KERAS_NAMES: dict[type[nn.Module], tuple[str, dict[str, str]]] = {
    nn.Conv2d: ("conv2d", {"weight": "kernel", "bias": "bias"}),
    nn.ConvTranspose2d: ("conv2d_transpose", {"weight": "kernel", "bias": "bias"}),
    nn.BatchNorm2d: (
        "batch_normalization",
        {
            "weight": "gamma",
            "bias": "beta",
            "running_mean": "moving_mean",
            "running_var": "moving_variance",
        },
    ),
}


class DenseMapNet(nn.Module):
    """Network on which the paper builds. It predicts a disparity code in 0..1 for each left pixel.

    The network has 290,290 parameters and takes 8.41 G multiply-adds at 640x480.

    Args:
        channels: 3 for RGB, or 1 for grey (286,240 parameters), as published for KITTI 2015. The inputs of a
            grey network are also RGB. It converts them to grey with the Rec. 601 weights, as OpenCV and
            Pillow do; the author's own conversion is unknown.
    """

    multiple_of = 8
    predicts: ClassVar[Literal["code", "disparity_px"]] = "code"
    output_weights: ClassVar[tuple[float, ...]] = (1.0,)

    def __init__(self, channels: Literal[1, 3] = 3) -> None:
        super().__init__()
        self.channels = channels
        self.matching = PooledMatching(channels)
        self.head = CodeHead(32)
        initialise_as_keras(self)

    def outputs(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"]]:
        """Return the code, the only supervised output."""
        height, width = left.shape[2:]
        left, right = (pad_to_multiple(view, self.multiple_of) for view in (left, right))
        if self.channels == 1:
            left, right = _to_grey(left), _to_grey(right)
        matches, _, left_channel = self.matching(left, right)
        code = self.head(F.interpolate(matches, scale_factor=8.0), left_channel)
        return (code[..., :height, :width],)

    def forward(
        self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b 1 h w"]:
        """Return the left view's code [B, 1, H, W] in 0..1; nearer surfaces have higher codes.

        The code of the published networks is disparity / d_max.

        Args:
            left: Left view [B, 3, H, W], RGB in 0..1, of any size.
            right: Right view, in the same format.
        """
        return self.outputs(left, right)[-1]


def load_keras(path: str | Path) -> DenseMapNet:
    """Load a published RGB or grey network from a Keras HDF5 weight file. Returns the network in eval mode.

    Its code is disparity / d_max. The file does not contain d_max, the largest disparity in training.

    Raises:
        FormatError: The file is missing or not HDF5, or its layers or shapes differ from DenseMapNet's.
    """
    found = _read_hdf5(path)
    first = found.get("conv2d_1/conv2d_1/kernel:0")
    network = DenseMapNet(channels=1 if first is not None and first.shape[2:] == (1, 16) else 3)
    with torch.no_grad():
        for name, values in _iterate_keras_tensors(network):
            if name not in found:
                raise FormatError(f"{path}: expected DenseMapNet's weights, found no {name}")
            theirs = found.pop(name)
            if theirs.shape != values.shape:
                raise FormatError(
                    f"{path}: expected {name} of shape {tuple(values.shape)}, found shape {theirs.shape}"
                )
            values.copy_(torch.from_numpy(theirs))
    if found:
        raise FormatError(f"{path}: expected only DenseMapNet's weights, also found {min(found)}")
    return network.eval()


def _read_hdf5(path: str | Path) -> dict[str, np.ndarray]:
    """Read all arrays in the file, keyed by their full names."""
    import h5py  # type: ignore[import-untyped]

    arrays = {}

    def keep(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            arrays[name] = item[()]

    try:
        with h5py.File(path) as file:
            file.visititems(keep)
    except FileNotFoundError as error:
        raise FormatError(f"{path}: expected Keras weights in HDF5, found no such file") from error
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        # HDF5's own message is long and spans several lines; it remains in the chained exception.
        raise FormatError(
            f"{path}: expected Keras weights in HDF5, found another format or a damaged file"
        ) from error
    return arrays


def _iterate_keras_tensors(network: nn.Module) -> Iterator[tuple[str, Tensor]]:
    """Yield the Keras name and the values of each tensor, with the axes in Keras's order.

    Keras numbers the layers of each type in the order of construction, which is the order of `modules()`.
    """
    count = Counter[str]()
    for layer in network.modules():
        if type(layer) in _KERAS_NAMES:
            kind, parts = _KERAS_NAMES[type(layer)]
            count[kind] += 1
            for ours, theirs in parts.items():
                values: Tensor = getattr(layer, ours)
                name = f"{kind}_{count[kind]}"
                yield (
                    f"{name}/{name}/{theirs}:0",
                    values.permute(2, 3, 1, 0) if values.ndim == 4 else values,
                )


def _to_grey(view: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
    red, green, blue = view.chunk(3, 1)
    return 0.299 * red + 0.587 * green + 0.114 * blue
