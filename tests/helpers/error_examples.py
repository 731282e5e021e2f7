"""Files that cause errors and notes whose remedies name settings."""

import functools
import shutil
import tempfile
from pathlib import Path

import numpy as np
from camera_examples import Taken, take, turn
from rig_examples import pinhole, rig_of

from stereoweave.cameras.calibration_files import write_rig
from stereoweave.io.images import read_image, write_image
from stereoweave.stereo import StereoPair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
LAYOUTS = (
    "side_by_side, side_by_side_half, top_bottom, top_bottom_half, crossed, crossed_half, "
    "top_bottom_right_first, top_bottom_right_first_half, row_interleaved, column_interleaved, checkerboard, "
    "row_interleaved_right_first, column_interleaved_right_first, checkerboard_right_first"
)


def write_error_examples(folder: Path) -> None:
    """Write a pair, the same pair with the right picture 2 px lower, converging cameras or a zoomed
    right picture, plain pictures, an upright one, and two calibrations.
    """
    for name, content in _make_error_examples().items():
        (folder / name).write_bytes(content)


@functools.cache
def _make_error_examples() -> dict[str, bytes]:
    """Return the files' contents by name. Made once, because each of many tests writes them."""
    with tempfile.TemporaryDirectory() as folder:
        _write_new_examples(Path(folder))
        return {file.name: file.read_bytes() for file in Path(folder).iterdir()}


def _write_new_examples(folder: Path) -> None:
    for name in ("left.png", "right.png"):
        shutil.copy(TEXTURED / name, folder)
    left, right = (read_image(TEXTURED / name) for name in ("left.png", "right.png"))
    write_image(folder / "upper.png", left[2:])
    write_image(folder / "lower.png", right[:-2])
    size, nowhere = (640, 480), np.zeros((1, 2))
    pair = Taken(StereoPair(left=left, right=right), nowhere, nowhere)
    inwards = take(pair, turn(size, (0, 1, 0)), turn(size, (0, -1, 1)))
    zoomed = take(pair, turn(size, (0, 0, 0)), turn(size, (0, 0, 0), scale=1.12))
    write_image(folder / "inwards_left.png", inwards.pair.left)
    write_image(folder / "inwards_right.png", inwards.pair.right)
    write_image(folder / "zoomed.png", zoomed.pair.right)
    write_image(folder / "both.png", np.hstack([left, right]))
    write_image(folder / "turned.png", np.ascontiguousarray(np.rot90(right)))
    write_image(folder / "plain.png", np.full((480, 640, 3), 90, np.uint8))
    write_rig(folder / "turned.yml", rig_of(pinhole))
    shutil.copy(Path(__file__).parents[2] / "examples" / "calib.txt", folder / "rectified.txt")
