"""Training set of ETH3D's two-view benchmark (Schöps et al. 2017), with one folder per scene."""

from functools import partial
from pathlib import Path

import numpy as np

from stereoweave.cameras.calibration_files import add_camera
from stereoweave.data.frames import Frame, list_scene_folders, require_folder
from stereoweave.data.samples import make_sample, require_size
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_pfm, read_pixels
from stereoweave.stereo import Sample


def list_eth3d(root: Path) -> list[Frame]:
    """List the scenes in two_view_training; their ground truth is in two_view_training_gt."""
    truth = require_folder(root / "two_view_training_gt")
    return [
        Frame(name=scene.name, read=partial(_read, scene, truth / scene.name))
        for scene in list_scene_folders(root / "two_view_training")
    ]


def _read(scene: Path, truth: Path) -> Sample:
    pair = add_camera(read_pair(scene / "im0.png", scene / "im1.png"), scene / "calib.txt")
    disparity, visible = truth / "disp0GT.pfm", truth / "mask0nocc.png"
    disparity_px = require_size(read_pfm(disparity), disparity, pair)
    # 255 means visible in both images; lower values mean occluded or unknown.
    both = require_size(read_pixels(visible, "L"), visible, pair) == 255
    return make_sample(pair, disparity_px, occluded=np.isfinite(disparity_px) & ~both)
