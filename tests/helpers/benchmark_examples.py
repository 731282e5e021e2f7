"""Shared by the tests of submissions: miniatures of the benchmarks' downloads, and a network for them."""

from pathlib import Path

import numpy as np
from dataset_examples import write_picture
from matcher_examples import matcher_file, red_of
from onnx import helper

CALIBRATION = """\
cam0=[100 0 20; 0 100 16; 0 0 1]
cam1=[100 0 20; 0 100 16; 0 0 1]
doffs=0
baseline=50
width=40
height=32
ndisp={ndisp}
"""
KITTI = {"kitti2012": ("image_0", "image_1"), "kitti2015": ("image_2", "image_3")}


def write_kitti(root: Path, dataset: str, count: int = 2) -> Path:
    for folder in KITTI[dataset]:
        for number in range(count):
            for moment in ("10", "11"):
                write_picture(root / "testing" / folder / f"{number:06}_{moment}.png", 90)
    return root


def write_scene(folder: Path, shape: tuple[int, int] = (32, 40), ndisp: object = 20) -> None:
    write_picture(folder / "im0.png", 90, shape)
    write_picture(folder / "im1.png", 90, shape)
    (folder / "calib.txt").write_text(CALIBRATION.format(ndisp=ndisp))


def write_middlebury(root: Path, *letters: str) -> Path:
    for letter in letters or ("Q",):
        write_scene(root / "MiddEval3" / f"training{letter}" / "Adirondack")
        write_scene(root / "MiddEval3" / f"test{letter}" / "Plants", (36, 44))
    return root


def write_eth3d(root: Path) -> Path:
    write_scene(root / "two_view_training" / "forest_1s")
    write_scene(root / "two_view_test" / "lakeside_1l", (36, 44))
    return root


def write_constant_matcher(path: Path, disparity_px: float) -> Path:
    """Write a network that finds one disparity everywhere."""
    constants = {"zero": 0.0, "disparity": disparity_px}
    nodes = [
        *(helper.make_node("Constant", [], [name], value_float=value) for name, value in constants.items()),
        *red_of("left", "level"),
        helper.make_node("Mul", ["level", "zero"], ["zeros"]),
        helper.make_node("Add", ["zeros", "disparity"], ["disparity_px"]),
    ]
    return matcher_file(path, nodes, ["disparity_px"])


def parse_pfm(content: bytes) -> np.ndarray:
    """Return the values of a PFM file, top row first, without the package's reader."""
    kind, size, scale, values = content.split(b"\n", 3)
    assert kind == b"Pf"
    assert float(scale) == -1.0
    width, height = map(int, size.split())
    assert len(values) == 4 * width * height
    return np.frombuffer(values, "<f4").reshape(height, width)[::-1]
