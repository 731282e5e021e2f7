"""The forms in which the functions of the Python interface take an image."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from stereoweave.io.images import write_image


def written(image: np.ndarray, file: Path) -> Path:
    write_image(file, image)
    return file


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.copy())


# Functions of uint8 RGB [H, W, 3] and the path of a .png file that may be written.
IMAGE_FORMS: dict[str, Callable[[np.ndarray, Path], Any]] = {
    "Path": written,
    "str": lambda image, file: str(written(image, file)),
    "PIL": lambda image, _: Image.fromarray(image),
    "array of floats": lambda image, _: image.astype(np.float32) / 255,
    "array [3, H, W]": lambda image, _: np.moveaxis(image, 2, 0),
    "tensor [H, W, 3]": lambda image, _: tensor(image),
    "tensor [1, 3, H, W] of floats": lambda image, _: tensor(image).permute(2, 0, 1)[None] / 255,
}
