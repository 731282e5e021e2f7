"""Training sets of KITTI stereo 2012 (Geiger et al.) and 2015 (Menze and Geiger), from unpacked archives."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from stereoweave.cameras.calibration_files import read_calibration_bytes
from stereoweave.data.frames import Frame, match_files, require_folder
from stereoweave.data.samples import make_sample, require_size
from stereoweave.errors import FormatError
from stereoweave.io.files import reading
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_disparity_png
from stereoweave.stereo import Sample, StereoCamera, StereoPair


def list_kitti2012(root: Path) -> list[Frame]:
    """List the 194 grey pairs of KITTI 2012, such as 000000_10.

    The ground truth is for the grey cameras, 0 and 1. According to the calibration, the colour cameras, 2 and
    3, are mounted 6 cm to the side of the grey cameras.
    """
    training = root / "training"
    folders = [training / name for name in ("image_0", "image_1", "disp_occ", "disp_noc")]
    return _list_frames(folders, training / "calib", ("P0", "P1"))


def list_kitti2015(root: Path) -> list[Frame]:
    """List the 200 colour pairs of KITTI 2015, such as 000000_10.

    The folder calib_cam_to_cam comes in a separate archive. The folder disp_occ_1 is not read, because it
    contains the left view's disparity at the next time step, not the right view's disparity.
    """
    training = root / "training"
    folders = [training / name for name in ("image_2", "image_3", "disp_occ_0", "disp_noc_0")]
    return _list_frames(folders, training / "calib_cam_to_cam", ("P_rect_02", "P_rect_03"))


def _list_frames(folders: list[Path], calibrations: Path, keys: tuple[str, str]) -> list[Frame]:
    require_folder(calibrations)
    return [
        Frame(name=name, read=partial(_read, files, calibrations / f"{name.removesuffix('_10')}.txt", keys))
        # The pictures of the next time step, _11, have no ground truth.
        for name, files in match_files(*folders, ending="_10").items()
    ]


def _read(files: list[Path], calibration: Path, keys: tuple[str, str]) -> Sample:
    left, right, disparity, visible = files
    pair = replace(read_pair(left, right), camera=_read_camera(calibration, keys))
    disparity_px, visible_px = (_read_disparity(path, pair) for path in (disparity, visible))
    return make_sample(pair, disparity_px, occluded=np.isfinite(disparity_px) & np.isnan(visible_px))


def _read_disparity(path: Path, pair: StereoPair) -> Float32[np.ndarray, "h w"]:
    return require_size(read_disparity_png(path), path, pair)


def _read_camera(path: Path, keys: tuple[str, str]) -> StereoCamera:
    """Read the camera from the projection matrices P = K [I | t] of both cameras.

    The baseline is the left camera's t_x minus the right camera's t_x, where t_x is P[0, 3] / focal_px.
    """
    with reading(path, "a KITTI calibration"):
        lines = (
            line.partition(":") for line in read_calibration_bytes(path).decode(errors="replace").splitlines()
        )
        entries = {key: numbers.split() for key, _, numbers in lines}
        missing = [key for key in keys if len(entries.get(key, [])) != 12]
        if missing:
            raise FormatError(
                f"{path}: expected a KITTI calibration with 12 numbers each for {' and '.join(keys)}, "
                f"found no such entry for {' or '.join(missing)}"
            )
        left, right = (np.array(entries[key], float).reshape(3, 4) for key in keys)
        return StereoCamera(
            focal_px=float(left[0, 0]),
            baseline_m=float((left[0, 3] - right[0, 3]) / left[0, 0]),
            cx_px=float(left[0, 2]),
            cy_px=float(left[1, 2]),
            doffs_px=float(right[0, 2] - left[0, 2]),
        )
