"""Perceptual loss, which compares maps by the features of a network trained on photographs."""

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.errors import FormatError, reason

WEIGHTS = "vgg16-397923af.pth, torchvision's VGG-16 trained on ImageNet"


class PerceptualLoss(nn.Module):
    """Feature reconstruction loss of Johnson et al. (2016) between codes, computed on VGG-16's relu2_2.

    Johnson et al. use relu2_2 to reconstruct images; deeper layers localise edges less well. The weights are
    frozen. The file needs to contain only the weights of the first four convolutions.

    Args:
        weights: File with VGG-16's weights under torchvision's names; never downloaded automatically.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, weights: Path) -> None:
        super().__init__()
        # Without storage, so that no random numbers are drawn, and a seed gives the same training with any
        # loss.
        with torch.device("meta"):
            self.features = nn.Sequential(
                *_convolution(3, 64), *_convolution(64, 64), nn.MaxPool2d(2),
                *_convolution(64, 128), *_convolution(128, 128),
            )  # fmt: skip
        self.load_state_dict(_read(weights, self.state_dict()), assign=True)
        self.requires_grad_(False)
        # VGG-16 was trained with ImageNet's statistics. They are not in the state, because the file has none.
        mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
        self.register_buffer("mean", mean.view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", deviation.view(3, 1, 1), persistent=False)

    def forward(self, code: Float[Tensor, "b 1 h w"], truth: Float[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
        """Return the mean squared difference of the features; 0 if no pixels are known.

        A feature covers 14x14 pixels, so unknown pixels cannot be masked afterwards. In both maps, they are
        set to the prediction, so that the maps are equal there and have no gradient. The mean is divided by
        the share of known pixels, so that sparse ground truth weighs as much as in the other losses.

        Args:
            code: Predicted code in 0..1.
            truth: True code in 0..1; NaN where unknown.
        """
        self.to(code.device)
        known = truth.isfinite()
        shown, expected = (values.where(known, code.detach()) for values in (code, truth))
        difference = F.mse_loss(self._extract_features(shown), self._extract_features(expected))
        return difference * known.numel() / known.sum().clamp(min=1)

    def _extract_features(self, code: Tensor) -> Tensor:
        # The subtraction broadcasts the one channel to three.
        return self.features((code - self.mean) / self.deviation)


def _convolution(inputs: int, outputs: int) -> tuple[nn.Module, nn.Module]:
    return nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()


def _read(path: Path, expected: dict[str, Tensor]) -> dict[str, Tensor]:
    """Read the tensors named in `expected` as float32.

    Raises:
        FormatError: If a tensor is missing or has the wrong shape.
    """
    found = _load(path)
    for name, tensor in expected.items():
        shape = list(getattr(found.get(name), "shape", [])) or "none"
        if shape != list(tensor.shape):
            raise FormatError(
                f"{path}: {name}: expected shape {list(tensor.shape)}, found {shape}; is the file {WEIGHTS}?"
            )
    return {name: found[name].float() for name in expected}


def _load(path: Path) -> dict[str, Any]:
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise FormatError(
            f"{path}: no such file; expected {WEIGHTS}, which is never downloaded automatically"
        ) from error
    except Exception as error:  # PyTorch's reader raises any type of error on invalid bytes
        raise FormatError(f"{path}: expected {WEIGHTS}, found {reason(error)}") from error
    if not isinstance(found, dict):
        raise FormatError(f"{path}: expected {WEIGHTS}, found a {type(found).__name__}")
    return found
