"""Rectification of a video by a calibration file."""

from pathlib import Path

from stereoweave.cameras.calibration_files import read_rig
from stereoweave.cameras.rig import Rig
from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.video.reader import StereoVideo


def rectify_by(video: StereoVideo, calibration: Path | None, *, rectify: bool | None) -> StereoVideo:
    """Return a video with frames that are rectified by a calibration file; see `StereoVideo.rectify`.

    Without a calibration, the video is returned as it is.

    Raises:
        StereoweaveError: The file is unreadable or does not fit the video; or `rectify` is False and the
            frames are not rectified as they are.
    """
    if calibration is None:
        return video
    return _rectify(video, read_rig(calibration, video.size_px), calibration, rectify)


def rectify_if_it_fits(video: StereoVideo, calibration: Path | None, *, rectify: bool | None) -> StereoVideo:
    """Return the result of `rectify_by`, or the video as it is if the file is for frames of another size.

    A window of a panorama is returned as it is, too. Raises the other errors of `rectify_by`.
    """
    if calibration is None or video.sphere:
        return video
    rig = read_rig(calibration, video.size_px)
    fits = rig.size_px in (None, video.size_px)
    return _rectify(video, rig, calibration, rectify) if fits else video


def _rectify(video: StereoVideo, rig: Rig, calibration: Path, rectify: bool | None) -> StereoVideo:
    unlike = rig.unlike_rectified()
    if rectify is False and unlike:
        raise StereoweaveError(
            f"{calibration}: expected a calibration of rectified frames, found {unlike}",
            remedy=Remedy("rectify the frames with it", ("rectify",)),
        )
    return video.rectify(rig)
