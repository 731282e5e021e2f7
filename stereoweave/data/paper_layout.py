"""The folders of "Fast Depth Estimation for View Synthesis" (section IV-A): left, right and depth.

The paper says that depth, of the left view, reaches from 0 to 15 m, and not how its files hold it. Two ways
are read:

- 16-bit grey PNG of millimetres; 0 is unknown, and so is what is beyond 15 m;
- 8-bit RGB PNG of (R + 256 G + 65536 B) / (2^24 - 1) of 15 m, lowest byte first, as the simulator CARLA packs
  it; 0 is unknown, and so is the greatest number, where 15 m cannot be told from what is beyond it.
"""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from stereoweave.data.frames import Frame, matched
from stereoweave.data.samples import make_sample, of_its_size
from stereoweave.errors import FormatError
from stereoweave.io import calibrated, read_pair, read_pixels
from stereoweave.stereo import Sample

RANGE_M = 15.0
_PACKED_MAX = 2**24 - 1


def paper(root: Path) -> list[Frame]:
    """The frames of left, right and depth, which hold files of equal names, in subfolders or not: scene/0001.

    One camera made them all: calib.txt, in Middlebury's format, beside the three folders.
    """
    camera = root / "calib.txt"
    if not camera.exists():
        raise FormatError(f"{camera}: expected the camera in Middlebury's format, found no such file")
    folders = [root / name for name in ("left", "right", "depth")]
    return [Frame(name=name, read=partial(_read, files, camera)) for name, files in matched(*folders).items()]


def _read(files: list[Path], camera: Path) -> Sample:
    left, right, depth = files
    pair = calibrated(read_pair(left, right), camera)
    assert pair.camera is not None
    depth_m = _depth_m(of_its_size(read_pixels(depth, "I;16", "RGB"), depth, pair))
    return make_sample(pair, pair.camera.disparity_px(depth_m))


def _depth_m(stored: Shaped[np.ndarray, "h w *channels"]) -> Float[np.ndarray, "h w"]:
    """Depth in metres, NaN where it is unknown."""
    if stored.ndim == 2:
        return np.where((stored > 0) & (stored <= 1000 * RANGE_M), stored / 1000, np.nan)
    packed = stored @ np.array([1, 256, 65536])
    return np.where((packed > 0) & (packed < _PACKED_MAX), packed / _PACKED_MAX * RANGE_M, np.nan)
