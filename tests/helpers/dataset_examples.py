"""Shared by the tests of datasets: small files in the datasets' encodings, and their errors."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stereoweave.data.readers import open_dataset
from stereoweave.errors import StereoweaveError
from stereoweave.io import maps
from stereoweave.stereo import Sample

SHAPE = 32, 40


def write_pixels(path: Path, values: np.ndarray) -> None:
    """Write pixel values unchanged; dtype and file name determine mode and format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"lossless": True} if path.suffix == ".webp" else {}
    Image.fromarray(values).save(path, **options)


def write_picture(path: Path, shade: int, shape: tuple[int, int] = SHAPE) -> None:
    """Write a picture of uniform grey, by which tests distinguish left and right."""
    write_pixels(path, np.full((*shape, 3), shade, np.uint8))


def write_map(path: Path, start: list, rest: float, kind: type, shape: tuple[int, int] = SHAPE) -> None:
    """Write a map whose first row begins with `start`, as PFM or picture by the file name."""
    values = np.full((*shape, *np.shape(rest)), rest, kind)
    if start:
        values[0, : len(start)] = start
    if path.suffix == ".pfm":
        maps.write_pfm(path, values)
    else:
        write_pixels(path, values)


def read_frame(dataset: str, root: Path, name: str) -> Sample:
    (frame,) = (frame for frame in open_dataset(dataset, root) if frame.name == name)
    return frame.read()


def names(dataset: str, root: Path) -> list[str]:
    return [frame.name for frame in open_dataset(dataset, root)]


def shades(sample: Sample) -> tuple[int, int]:
    """Return the greys of the left and right image of a sample."""
    return int(sample.left[0, 0, 0]), int(sample.right[0, 0, 0])


def cut(path: Path) -> None:
    """Truncate a file to its first half."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def error_of(call: Callable, *arguments: object) -> str:
    """Return the one-line error that the call must raise."""
    with pytest.raises(StereoweaveError) as caught:
        call(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert "expected" in message
    assert "found" in message
    return message


def error_naming(path: Path, dataset: str, root: Path) -> str:
    """Return the error of reading the whole dataset, which must name the file or folder."""
    message = error_of(lambda: [frame.read() for frame in open_dataset(dataset, root)])
    assert str(path) in message
    return message
