"""Training set of MPI Sintel stereo (Butler et al. 2012; Wulff and Black 2015), from unpacked archives."""

import struct
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.data.frames import Frame, match_files
from stereoweave.data.samples import make_sample, require_size
from stereoweave.errors import FormatError
from stereoweave.io.files import read_small, reading
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_pixels
from stereoweave.stereo import Sample, StereoCamera

# "Rendered from two cameras with a baseline of 10 cm apart": the dataset's README.
_BASELINE_M = 0.1
_CAM = struct.Struct("<f 9d 12d")
_CAM_TAG = 202021.25


def list_sintel(root: Path) -> list[Frame]:
    """List the 1,064 frames in `root`/training, each in both passes, such as clean/alley_1/frame_0001.

    The camera is known if training/camdata_left, from Sintel's depth archive, is also unpacked.
    """
    training = root / "training"
    truth = [training / folder for folder in ("disparities", "occlusions", "outofframe")]
    cameras = training / "camdata_left"
    return [
        Frame(name=f"{kind}/{name}", read=partial(_read, files, cameras / f"{name}.cam"))
        for kind in ("clean", "final")
        for name, files in match_files(training / f"{kind}_left", training / f"{kind}_right", *truth).items()
    ]


def _read(files: list[Path], camera: Path) -> Sample:
    left, right, disparity, occlusions, outofframe = files
    pair = read_pair(left, right)
    if camera.parents[1].is_dir():
        pair = replace(pair, camera=_read_camera(camera))
    packed = require_size(read_pixels(disparity, "RGB"), disparity, pair)
    # Both masks mark pixels that the right camera does not see, either occluded or outside its picture.
    occluded = [
        require_size(read_pixels(mask, "L", "1"), mask, pair) > 0 for mask in (occlusions, outofframe)
    ]
    return make_sample(pair, _unpack_px(packed), occluded=occluded[0] | occluded[1])


def _unpack_px(packed: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Return the disparity packed into RGB: R * 4 + G / 2^6 + B / 2^14.

    The dataset's README calls these values "negative disparities", because a match lies farther left, but the
    numbers are positive.
    """
    return (packed @ np.array([4, 2**-6, 2**-14])).astype(np.float32)


def _read_camera(path: Path) -> StereoCamera:
    """Read a .cam file: a tag, 3x3 intrinsics and 3x4 extrinsics, row by row and little-endian."""
    with reading(path, "an MPI Sintel camera"):
        content = read_small(path)
        if len(content) != _CAM.size or struct.unpack_from("<f", content)[0] != _CAM_TAG:
            raise FormatError(
                f"{path}: expected an MPI Sintel camera of {_CAM.size} bytes that begin with {_CAM_TAG}, "
                f"found {len(content)} bytes that begin with {content[:4]!r}"
            )
        _, focal_px, _, cx_px, _, _, cy_px, *_ = _CAM.unpack(content)
        return StereoCamera(focal_px=focal_px, baseline_m=_BASELINE_M, cx_px=cx_px, cy_px=cy_px)
