"""Datasets in the layout of "Fast Depth Estimation for View Synthesis" (section IV-A).

The folders are left, right and depth.

The paper states the range of the left view's depth, which is 0 to 15 m, but not the file format. Two formats
can be read:

- 16-bit grey PNG with depth in millimetres; 0 and values beyond 15 m are unknown;
- 8-bit RGB PNG with depth as a fraction of 15 m, (R + 256 G + 65536 B) / (2^24 - 1), as in the simulator
  CARLA; 0 and the maximum, which also represents anything beyond 15 m, are unknown.

Frames are written in the second format. The checksums of a frame, in sums/NAME.sha256, are written last, so a
frame with checksums is complete. Running `sha256sum --check sums/NAME.sha256` in the root verifies the frame.
"""

import os
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from stereoweave.cameras.calibration_files import add_camera
from stereoweave.data.checksums import make_checksums, verify_checksums
from stereoweave.data.frames import Frame, match_files
from stereoweave.data.samples import make_sample, require_size
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import reading, replacing
from stereoweave.io.images import read_pair, write_image
from stereoweave.io.maps import read_pixels
from stereoweave.stereo import Sample, StereoCamera

RANGE_M = 15.0
_PACKED_MAX = 2**24 - 1
_ENDINGS = {"left": "png", "right": "png", "calib": "txt", "depth": "png"}


def list_paper(root: Path) -> list[Frame]:
    """List the frames, such as scene/0001 or scene/world/0001, with a file each in left, right and depth.

    Cameras are in Middlebury's format. If there is a calib.txt beside the folders, it applies to all frames;
    otherwise, each frame has its own file, such as calib/scene/0001.txt.
    """
    camera = root / "calib.txt"
    if not (camera.exists() or (root / "calib").is_dir()):
        raise FormatError(f"{camera}: expected a camera in Middlebury's format, found no such file")
    folders = [root / name for name in ("left", "right", "depth")]

    def find_camera(name: str) -> Path:
        return camera if camera.exists() else _frame_files(root, name)["calib"]

    frames = match_files(*folders).items()
    return [Frame(name=name, read=partial(_read, files, find_camera(name))) for name, files in frames]


def write_frame(root: Path, name: str, sample: Sample) -> None:
    """Write a frame and its camera, then the checksums, which mark the frame as complete.

    Depths of 15 m or more, which are beyond the range of the paper's camera, become unknown.

    Raises:
        StereoweaveError: The sample has no camera, or the folder is full or not writable.
    """
    if sample.camera is None:
        raise StereoweaveError(
            f"{root}: expected a sample with a camera, because depth depends on it, found none"
        )
    files = _frame_files(root, name)
    write_image(files["left"], sample.left)
    write_image(files["right"], sample.right)
    _write_text(files["calib"], _format_calibration(sample.camera, sample.left.shape[:2]))
    write_image(files["depth"], _pack_depth(sample.camera.depth_m(sample.disparity_px)))
    contents = {path.relative_to(root).as_posix(): _read_synced(path) for path in files.values()}
    _write_text(_checksum_file(root, name), make_checksums(contents).decode())


def list_complete_frames(root: Path) -> list[str]:
    """Return the sorted names of all complete frames."""
    sums = root / "sums"
    return sorted(path.relative_to(sums).with_suffix("").as_posix() for path in sums.rglob("[!.]*.sha256"))


def remove_unfinished(root: Path) -> None:
    """Remove the files of incomplete frames. No other process may be writing to the folder."""
    whole = set(list_complete_frames(root))
    for folder in (root / name for name in _ENDINGS):
        for path in folder.rglob("*.*"):
            if path.relative_to(folder).with_suffix("").as_posix() not in whole:
                path.unlink()


def check_frame(root: Path, name: str) -> None:
    """Raise a FormatError if a file of a written frame is damaged or missing."""
    sums = _checksum_file(root, name)
    with reading(sums, "the checksums of a frame"):
        expected = sums.read_bytes()
    contents = {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in _frame_files(root, name).values()
        if path.exists()
    }
    remedy = f"delete {sums}, and rerun the same `stereoweave synth make` command"
    verify_checksums(contents, expected, root, remedy)


def _read(files: list[Path], camera: Path) -> Sample:
    left, right, depth = files
    pair = add_camera(read_pair(left, right), camera)
    assert pair.camera is not None
    depth_m = _unpack_depth_m(require_size(read_pixels(depth, "I;16", "RGB"), depth, pair))
    return make_sample(pair, pair.camera.disparity_px(depth_m))


def _unpack_depth_m(stored: Shaped[np.ndarray, "h w *channels"]) -> Float[np.ndarray, "h w"]:
    """Return the depth in metres from a picture in either format; NaN where unknown."""
    if stored.ndim == 2:
        return np.where((stored > 0) & (stored <= 1000 * RANGE_M), stored / 1000, np.nan)
    packed = stored @ np.array([1, 256, 65536])
    return np.where((packed > 0) & (packed < _PACKED_MAX), packed / _PACKED_MAX * RANGE_M, np.nan)


def _pack_depth(depth_m: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Pack depth into RGB in the format that `_unpack_depth_m` reads.

    Known depth is stored as at least 1, because 0 means unknown.
    """
    known = (depth_m > 0) & (depth_m < RANGE_M)
    number = np.rint(np.where(known, depth_m, 0) / RANGE_M * _PACKED_MAX).clip(1, _PACKED_MAX - 1)
    number = np.where(known, number, 0).astype(np.uint32)
    return np.stack([number & 255, number >> 8 & 255, number >> 16], axis=-1).astype(np.uint8)


def _format_calibration(camera: StereoCamera, shape: tuple[int, ...]) -> str:
    focal_px, cx_px, cy_px, doffs_px = camera.focal_px, camera.cx_px, camera.cy_px, camera.doffs_px
    return (
        f"cam0=[{focal_px} 0 {cx_px}; 0 {focal_px} {cy_px}; 0 0 1]\n"
        f"cam1=[{focal_px} 0 {cx_px + doffs_px}; 0 {focal_px} {cy_px}; 0 0 1]\n"
        f"doffs={doffs_px}\nbaseline={1000 * camera.baseline_m}\nwidth={shape[1]}\nheight={shape[0]}\n"
    )


def _frame_files(root: Path, name: str) -> dict[str, Path]:
    return {folder: root / folder / f"{name}.{ending}" for folder, ending in _ENDINGS.items()}


def _checksum_file(root: Path, name: str) -> Path:
    return root / "sums" / f"{name}.sha256"


def _read_synced(path: Path) -> bytes:
    """Read a file after syncing it to disk, so that a crash cannot keep its checksums but lose the file."""
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
        return stream.read()


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
