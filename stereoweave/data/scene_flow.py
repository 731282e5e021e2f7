"""Scene Flow (Mayer et al. 2016): FlyingThings3D, Driving and Monkaa, from unpacked archives.

The root contains the folder disparity, and frames_cleanpass, frames_finalpass or both. All these folders
have the same subfolders, the innermost of which are named left and right.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float32

from stereoweave.data.frames import Frame, match_files, require_folder
from stereoweave.data.samples import make_sample, require_size
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_pfm
from stereoweave.stereo import Sample, StereoCamera, StereoPair

_PASSES = {"clean": "frames_cleanpass", "final": "frames_finalpass"}

# Focal lengths published for pictures of 960x540, with lenses of 35 mm and, in half of Driving, 15 mm.
_FOCAL_35MM_PX, _FOCAL_15MM_PX = 1050.0, 450.0


def list_flyingthings3d(root: Path) -> list[Frame]:
    """List the frames of the full FlyingThings3D, TRAIN and TEST, such as clean/TRAIN/A/0000/0006."""
    return _list_frames(root, {"TRAIN": _FOCAL_35MM_PX, "TEST": _FOCAL_35MM_PX})


def list_driving(root: Path) -> list[Frame]:
    """List the frames of Driving, such as clean/15mm_focallength/scene_backwards/fast/0001."""
    return _list_frames(root, {"15mm_focallength": _FOCAL_15MM_PX, "35mm_focallength": _FOCAL_35MM_PX})


def list_monkaa(root: Path) -> list[Frame]:
    """List the frames of Monkaa, such as clean/a_rain_of_stones_x2/0000."""
    return _list_frames(root, {".": _FOCAL_35MM_PX})


def _list_frames(root: Path, focal_px: dict[str, float]) -> list[Frame]:
    # The passes are separate downloads of tens of gigabytes; one is enough.
    passes = {kind: root / folder for kind, folder in _PASSES.items() if (root / folder).is_dir()}
    if not passes:
        raise StereoweaveError(
            f"{root}: expected a folder named {' or '.join(_PASSES.values())} in it, found neither"
        )
    return [
        Frame(name=PurePosixPath(kind, part, name).as_posix(), read=partial(_read, files, part_focal_px))
        for kind, pictures in passes.items()
        for part, part_focal_px in focal_px.items()
        for name, files in _match_files(pictures / part, root / "disparity" / part)
    ]


def _match_files(pictures: Path, truth: Path) -> Iterator[tuple[str, list[Path]]]:
    tops = require_folder(pictures), require_folder(truth)
    sides = "left", "right"
    runs = {view.parent.relative_to(top) for top in tops for side in sides for view in top.rglob(side)}
    for run in sorted(runs):
        views = [top / run / side for top in tops for side in sides]
        for name, files in match_files(*views).items():
            yield (run / name).as_posix(), files


def _read(files: list[Path], focal_px: float) -> Sample:
    left, right, disparity, right_disparity = files
    # The baseline is 1 Blender unit, which is taken as 1 m. The principal point is as published.
    camera = StereoCamera(focal_px=focal_px, baseline_m=1.0, cx_px=479.5, cy_px=269.5)
    pair = replace(read_pair(left, right), camera=camera)
    return make_sample(pair, _read_disparity(disparity, pair), _read_disparity(right_disparity, pair))


def _read_disparity(path: Path, pair: StereoPair) -> Float32[np.ndarray, "h w"]:
    """Read a disparity map and return its absolute values.

    The subset of FlyingThings3D that was released later stores left disparities as negative values. The sign
    carries no information, because the cameras are parallel.

    Raises:
        FormatError: The map has the wrong size or contains disparities of both signs.
    """
    values_px = require_size(read_pfm(path), path, pair)
    if (values_px < 0).any() and (values_px > 0).any():
        raise FormatError(
            f"{path}: expected disparities of the same sign, found values from {np.nanmin(values_px):.3f} to "
            f"{np.nanmax(values_px):.3f}; is this a map of disparity changes?"
        )
    return np.abs(values_px)
