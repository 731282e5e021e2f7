"""Rectification of a video by a calibration file."""

from pathlib import Path

from stereoweave.cameras.calibration_files import read_rig
from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.video.reader import StereoVideo


def fits(video: StereoVideo, calibration: Path) -> bool:
    """Return whether a calibration file is for frames of this size, which are no windows of a panorama.

    Raises:
        FormatError: The file is unreadable.
    """
    return video.sphere is None and read_rig(calibration, video.size_px).size_px in (None, video.size_px)


def rectify_by(video: StereoVideo, calibration: Path, *, rectify: bool | None) -> StereoVideo:
    """Return a video with frames that are rectified by a calibration file; see `StereoVideo.rectify`.

    Raises:
        StereoweaveError: The file is unreadable or does not fit the video; or `rectify` is False and the
            frames are not rectified as they are.
    """
    rig = read_rig(calibration, video.size_px)
    unlike = rig.unlike_rectified()
    if rectify is False and unlike:
        raise StereoweaveError(
            f"{calibration}: expected a calibration of rectified frames, found {unlike}",
            remedy=Remedy("rectify the frames with it", ("rectify",)),
        )
    return video.rectify(rig)
