"""What the tests of the datasets share: small files in the datasets' own encodings, and their errors."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stereoweave.data.readers import open_dataset
from stereoweave.errors import StereoweaveError
from stereoweave.io import files as io
from stereoweave.stereo import Sample

SHAPE = 32, 40


def write_pixels(path: Path, values: np.ndarray) -> None:
    """Numbers as they are, in the mode of their type and in the format of the name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"lossless": True} if path.suffix == ".webp" else {}
    Image.fromarray(values).save(path, **options)


def write_picture(path: Path, shade: int, shape: tuple[int, int] = SHAPE) -> None:
    """A picture of one grey, by which a test tells left from right."""
    write_pixels(path, np.full((*shape, 3), shade, np.uint8))


def write_map(path: Path, start: list, rest: float, kind: type, shape: tuple[int, int] = SHAPE) -> None:
    """A map in which the first row begins with `start`; a PFM or a picture, by the name."""
    values = np.full((*shape, *np.shape(rest)), rest, kind)
    if start:
        values[0, : len(start)] = start
    if path.suffix == ".pfm":
        io.write_pfm(path, values)
    else:
        write_pixels(path, values)


def read_frame(dataset: str, root: Path, name: str) -> Sample:
    (frame,) = (frame for frame in open_dataset(dataset, root) if frame.name == name)
    return frame.read()


def names(dataset: str, root: Path) -> list[str]:
    return [frame.name for frame in open_dataset(dataset, root)]


def shades(sample: Sample) -> tuple[int, int]:
    """The greys of the left and of the right picture of a sample."""
    return int(sample.left[0, 0, 0]), int(sample.right[0, 0, 0])


def cut(path: Path) -> None:
    """Leaves the first half of a file."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def error_of(call: Callable, *arguments: object) -> str:
    """The one line of the error in which the call must end."""
    with pytest.raises(StereoweaveError) as caught:
        call(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert "expected" in message
    assert "found" in message
    return message


def error_naming(path: Path, dataset: str, root: Path) -> str:
    """The error of opening the dataset and reading all of it, which must name the file or folder."""
    message = error_of(lambda: [frame.read() for frame in open_dataset(dataset, root)])
    assert str(path) in message
    return message
