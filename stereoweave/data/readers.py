"""Access to datasets by name, as frames for training or as scenes for scoring a matcher."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from stereoweave.arguments import check_choice
from stereoweave.cameras.calibration_files import add_camera
from stereoweave.data import eth3d, kitti, middlebury, paper_layout, scene_flow, shards, sintel
from stereoweave.data.frames import Frame, require_folder
from stereoweave.data.samples import find_occluded
from stereoweave.data.splits import split_frames
from stereoweave.errors import FormatError, Remedy, StereoweaveError
from stereoweave.io.images import read_pair
from stereoweave.io.maps import read_disparity_png, read_pfm
from stereoweave.stereo import StereoPair

__all__ = ["DATASETS", "Frame", "Scene", "list_scenes", "open_dataset", "read_scenes", "split_frames"]

DATASETS: dict[str, Callable[[Path], list[Frame]]] = {
    "sintel": sintel.list_sintel,
    "flyingthings3d": scene_flow.list_flyingthings3d,
    "driving": scene_flow.list_driving,
    "monkaa": scene_flow.list_monkaa,
    "kitti2012": kitti.list_kitti2012,
    "kitti2015": kitti.list_kitti2015,
    "middlebury2001": middlebury.list_middlebury2001,
    "middlebury2003": middlebury.list_middlebury2003,
    "middlebury2005": middlebury.list_middlebury2005,
    "middlebury2006": middlebury.list_middlebury2006,
    "middlebury2014": middlebury.list_middlebury2014,
    "middlebury2021": middlebury.list_middlebury2021,
    "eth3d": eth3d.list_eth3d,
    "paper": paper_layout.list_paper,
    "paper_worlds": paper_layout.list_paper,
    "shards": shards.list_frames,
}


def open_dataset(name: str, root: str | Path) -> list[Frame]:
    """List the frames of a dataset, sorted by name, given the folder of its unpacked archives.

    Raises:
        StereoweaveError: The dataset is unknown, a folder is missing, or there are no frames.
        FormatError: A folder lacks a file that another has; a frame's `read` reports other missing files.
    """
    check_choice("dataset", name, DATASETS)
    frames = DATASETS[name](require_folder(Path(root)))
    if not frames:
        raise StereoweaveError(f"{root}: expected the unpacked archives of {name}, found no frames")
    return sorted(frames, key=lambda frame: frame.name)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A pair with ground truth, for scoring a matcher.

    Attributes:
        name: Name of the folder or frame.
        pair: The pair, with its camera if known.
        truth_px: float32 [H, W], true disparity of the left view; NaN where unknown.
        occluded: True occlusion mask of the left view; None if there is neither one nor right disparity.
    """

    name: str
    pair: StereoPair
    truth_px: Float32[np.ndarray, "h w"]
    occluded: Bool[np.ndarray, "h w"] | None = None


def read_scenes(folder: str | Path, dataset: str | None = None) -> Iterator[Scene]:
    """Return an iterator over the scenes in `folder`, with the arguments and errors of `list_scenes`."""
    return (read() for read in list_scenes(folder, dataset))


def list_scenes(folder: str | Path, dataset: str | None = None) -> list[Callable[[], Scene]]:
    """Return a function for each scene in `folder` that reads it, sorted by scene name.

    A scene is a folder with left.png, right.png, a disparity map and optionally Middlebury's calib.txt. The
    map is disparity.png (16 bits, pixels * 256; 0 means unknown) or disparity.pfm (NaN and infinity mean
    unknown). If there are no such folders, the scenes are the pairs of all sets in `folder` that
    `stereoweave synth make` rendered.

    Args:
        folder: Folder of the scenes.
        dataset: Name in `DATASETS`; if given, `folder` is read as that dataset.

    Raises:
        StereoweaveError: The folder contains no scenes, or `open_dataset` raises the error.
        FormatError: A file is missing, damaged or of the wrong size; raised when its scene is read.
    """
    if dataset:
        return [partial(_read_frame, frame) for frame in open_dataset(dataset, folder)]
    scenes = sorted(left.parent for left in Path(folder).glob("*/left.png"))
    if scenes:
        return [partial(_read_scene, scene) for scene in scenes]
    frames = shards.list_frames(Path(folder))
    if not frames:
        found = "neither" if Path(folder).exists() else "no such folder"
        raise StereoweaveError(
            f"{folder}: expected <scene>/left.png below it, or rendered sets, found {found}",
            remedy=Remedy("if it is a dataset, give its name", ("dataset",)),
        )
    return [partial(_read_frame, frame) for frame in frames]


def _read_frame(frame: Frame) -> Scene:
    sample = frame.read()
    pair = StereoPair(left=sample.left, right=sample.right, camera=sample.camera)
    # Without right truth, only pixels outside the right picture are found; more are from the dataset's mask.
    found = find_occluded(sample.disparity_px, sample.right_disparity_px)
    known = np.isfinite(sample.right_disparity_px).any() or not np.array_equal(sample.occluded, found)
    occluded = sample.occluded if known else None
    return Scene(name=frame.name, pair=pair, truth_px=sample.disparity_px, occluded=occluded)


def _read_scene(folder: Path) -> Scene:
    pair = read_pair(folder / "left.png", folder / "right.png")
    calibration = folder / "calib.txt"
    if calibration.exists():
        pair = add_camera(pair, calibration)
    truth_px = _read_truth(folder)
    if truth_px.shape != pair.left.shape[:2]:
        raise FormatError(
            f"{folder}: expected ground truth of the same shape as the pictures, {pair.left.shape[:2]}, "
            f"found {truth_px.shape}"
        )
    return Scene(name=folder.name, pair=pair, truth_px=truth_px)


def _read_truth(folder: Path) -> Float32[np.ndarray, "h w"]:
    pfm = folder / "disparity.pfm"
    if not pfm.exists():
        return read_disparity_png(folder / "disparity.png")
    values_px = read_pfm(pfm)
    return np.where(np.isfinite(values_px), values_px, np.float32(np.nan))
