"""Rectification of a video by a calibration file."""

from pathlib import Path

from stereoweave.cameras.calibration_files import read_rig
from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.video.reader import StereoVideo


def rectify_by(video: StereoVideo, calibration: Path, *, rectify: bool | None) -> StereoVideo:
    """Return a video with frames that are rectified by a calibration file; see `StereoVideo.rectify`.

    Raises:
        StereoweaveError: `rectify` is False; or the file is unreadable or does not fit the video.
    """
    if rectify is False:
        raise StereoweaveError(
            f"{calibration}: expected frames to rectify by it, found that they are not to be rectified",
            remedy=Remedy("omit one of them", ("calibration", "rectify")),
        )
    return video.rectify(read_rig(calibration, video.size_px))
