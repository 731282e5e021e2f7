"""Middlebury stereo datasets (Scharstein et al.) from 2001 to 2021, with one folder per scene."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from stereoweave.cameras.calibration_files import add_camera
from stereoweave.data.frames import Frame, list_scene_folders
from stereoweave.data.samples import make_sample, require_size
from stereoweave.errors import FormatError
from stereoweave.io.files import read_small, reading
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_pfm, read_pixels
from stereoweave.stereo import Sample, StereoCamera, StereoPair


@dataclass(frozen=True)
class _SceneFiles:
    """File names of a scene's views and disparities, and the scale of the stored disparities."""

    left: str
    right: str
    disparity: str
    right_disparity: str | None
    scale: int


_FILES_2001 = {
    "map": _SceneFiles("im0", "im1", "disp0", "disp1", 8),
    "tsukuba": _SceneFiles("scene1.row3.col3", "scene1.row3.col4", "truedisp.row3.col3", None, 16),
}
_OTHER_FILES_2001 = _SceneFiles("im2", "im6", "disp2", "disp6", 8)

# Downscaling factor by height. Grey levels are disparities at full size, so they are divided by this factor.
_2003_SHRINKING = {1500: 1, 750: 2, 375: 4}
_2006_SHRINKING = {1110: 1, 555: 2, 370: 3}

# Three scenes of 2005 are published without ground truth.
_WITHOUT_TRUTH_2005 = {"Computer", "Drumsticks", "Dwarves"}


def list_middlebury2001(root: Path) -> list[Frame]:
    """List the eight scenes of 2001, in most cases with views 2 and 6; no camera is published."""
    return [
        Frame(
            name=scene.name, read=partial(_read_2001, scene, _FILES_2001.get(scene.name, _OTHER_FILES_2001))
        )
        for scene in list_scene_folders(root)
    ]


def list_middlebury2003(root: Path) -> list[Frame]:
    """List cones and teddy, with views 2 and 6 at full, half or quarter size; no camera is published."""
    return [Frame(name=scene.name, read=partial(_read_2003, scene)) for scene in list_scene_folders(root)]


def list_middlebury2005(root: Path) -> list[Frame]:
    """List the scenes of 2005, such as Art or Art/Illum1/Exp0.

    The pictures of a pair are views 1 and 5, at full, half or third size.
    """
    return [
        Frame(name=views.relative_to(root).as_posix(), read=partial(_read_2006, scene, views))
        for scene in list_scene_folders(root)
        if scene.name not in _WITHOUT_TRUTH_2005
        # Two-view archives have one picture per view. Seven-view archives have one picture per view for each
        # illumination and exposure.
        for views in sorted(scene.glob("Illum*/Exp*")) or [scene]
    ]


def list_middlebury2006(root: Path) -> list[Frame]:
    """List the scenes of 2006, such as Aloe or Aloe/Illum1/Exp0, organised like those of 2005."""
    return list_middlebury2005(root)


def list_middlebury2014(root: Path) -> list[Frame]:
    """List the scenes of 2014 with default illumination, such as Adirondack-perfect."""
    return [Frame(name=scene.name, read=partial(_read_2014, scene)) for scene in list_scene_folders(root)]


def list_middlebury2021(root: Path) -> list[Frame]:
    """List the scenes of 2021, such as artroom1, organised like those of 2014."""
    return list_middlebury2014(root)


def _read_2001(scene: Path, names: _SceneFiles) -> Sample:
    pair = read_pair(_find_picture(scene, names.left), _find_picture(scene, names.right))
    disparity_px = _read_levels(_find_picture(scene, names.disparity), pair) / names.scale
    if names.right_disparity is None:
        return make_sample(pair, disparity_px)
    return make_sample(
        pair, disparity_px, _read_levels(_find_picture(scene, names.right_disparity), pair) / names.scale
    )


def _read_2003(scene: Path) -> Sample:
    left = _find_picture(scene, "im2")
    pair = read_pair(left, _find_picture(scene, "im6"))
    shrinking = _find_shrinking(left, pair, _2003_SHRINKING)
    maps = (_read_levels(_find_picture(scene, name), pair) / shrinking for name in ("disp2", "disp6"))
    return make_sample(pair, *maps)


def _read_2006(scene: Path, views: Path) -> Sample:
    left = views / "view1.png"
    pair = read_pair(left, views / "view5.png")
    shrinking = _find_shrinking(left, pair, _2006_SHRINKING)
    pair = replace(pair, camera=_read_camera_2006(scene / "dmin.txt", pair, shrinking))
    maps = (_read_levels(scene / name, pair) / shrinking for name in ("disp1.png", "disp5.png"))
    return make_sample(pair, *maps)


def _read_2014(scene: Path) -> Sample:
    pair = add_camera(read_pair(scene / "im0.png", scene / "im1.png"), scene / "calib.txt")
    maps = (require_size(read_pfm(path), path, pair) for path in (scene / "disp0.pfm", scene / "disp1.pfm"))
    return make_sample(pair, *maps)


def _find_picture(scene: Path, name: str) -> Path:
    """Return a picture's path, with the extension .ppm or .pgm if such a file exists and .png otherwise."""
    kinds = (scene / f"{name}{suffix}" for suffix in (".ppm", ".pgm"))
    return next((path for path in kinds if path.exists()), scene / f"{name}.png")


def _read_levels(path: Path, pair: StereoPair) -> Float32[np.ndarray, "h w"]:
    """Read the grey levels of a disparity map; level 0, which means unknown, becomes NaN."""
    levels = require_size(read_pixels(path, "L"), path, pair)
    return np.where(levels > 0, levels, np.nan).astype(np.float32)


def _find_shrinking(path: Path, pair: StereoPair, by_height_px: dict[int, int]) -> int:
    height_px = pair.left.shape[0]
    if height_px not in by_height_px:
        heights = ", ".join(map(str, by_height_px))
        raise FormatError(
            f"{path}: expected a published height ({heights} pixels), found {height_px}; use the published "
            "picture, because its size determines the unit of the disparities"
        )
    return by_height_px[height_px]


def _read_camera_2006(dmin: Path, pair: StereoPair, shrinking: int) -> StereoCamera:
    """Return the published camera, with a focal length of 3740 px at full size and a baseline of 160 mm.

    dmin.txt gives the amount by which cropping reduced each disparity, always in full-size pixels. No
    principal point is published, so it is set to the centre of the picture.
    """
    with reading(dmin, "a number of pixels"):
        doffs_px = float(read_small(dmin).decode(errors="replace")) / shrinking
        height_px, width_px = pair.left.shape[:2]
        return StereoCamera(
            focal_px=3740 / shrinking,
            baseline_m=0.16,
            cx_px=(width_px - 1) / 2,
            cy_px=(height_px - 1) / 2,
            doffs_px=doffs_px,
        )
