"""Disparity as the grey levels of a video, and what their levels and colours mean."""

from math import isfinite

import numpy as np
from jaxtyping import Float, UInt16

from stereoweave.errors import Note, Remedy
from stereoweave.stereo import StereoCamera
from stereoweave.video.job import VideoJob
from stereoweave.video.survey import Survey

_STEPS_PER_PX, _MOST_GREY16_PX = 256, 255.99
# Black and white of a video in 10 bits.
_BLACK_10, _WHITE_10 = 64, 940
_NO_METRES = "no depth in metres, because frames were rectified"


def encode_grey10(
    disparity_px: Float[np.ndarray, "h w"], range_px: tuple[float, float]
) -> UInt16[np.ndarray, "h w"]:
    """Return grey levels from 64 to 940, linear over a range of disparities."""
    low_px, high_px = range_px
    share = np.clip((disparity_px - low_px) / (high_px - low_px), 0, 1)
    return np.rint(_BLACK_10 + (_WHITE_10 - _BLACK_10) * share).astype(np.uint16)


def encode_grey16(disparity_px: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Return disparity * 256, from 1 to 65535. The value 0 is reserved for unknown, as in disparity.png."""
    return np.clip(np.rint(_STEPS_PER_PX * disparity_px), 1, 65535).astype(np.uint16)


def find_losses(job: VideoJob, survey: Survey) -> list[Note]:
    """Return a list that contains a note if the output format cannot represent all disparities."""
    low_px, high_px = survey.range_px
    if not job.depth16 or (low_px >= 0 and high_px <= _MOST_GREY16_PX):
        return []
    text = (
        f"16-bit grey covers 0 to {_MOST_GREY16_PX} px; this video's disparities range from "
        f"{low_px:.1f} to {high_px:.1f} px, so some are clipped"
    )
    return [Note(text, Remedy("show all of them in colours", ("depth",)))]


def describe_values(
    job: VideoJob, survey: Survey, camera: StereoCamera | None = None, *, rectified: bool = False
) -> dict[str, str]:
    """Return metadata for the output file that explains how pixel values encode disparity.

    With a camera, it also explains their depth in metres, or says that rectified frames have none: their
    rectification turns the cameras, which shifts the disparity of infinitely far points.
    """
    ending = f"; {_NO_METRES}" if camera and rectified else ""
    camera = None if rectified else camera
    low_px, high_px = survey.range_px
    if job.depth16:
        text = f"16-bit grey: disparity of the left view in pixels = value / {_STEPS_PER_PX}"
        if camera:
            text += f"; depth in metres = {_divide(camera, 'value', _STEPS_PER_PX)}"
        return {"comment": text + ending}
    if job.depth10:
        step_px = (high_px - low_px) / (_WHITE_10 - _BLACK_10)
        text = (
            f"10-bit grey: disparity of the left view in pixels = {low_px:.4f} + {step_px:.7f} * "
            f"(value - {_BLACK_10}), for values from {_BLACK_10} to {_WHITE_10}"
        )
        if camera:
            text += f"; depth in metres = {_divide(camera, 'disparity')}"
        return {"comment": text + ending}
    if job.depth and job.whole is not None:
        return {"comment": job.whole.describe_nearness(survey.range_px)}
    if job.depth:
        low, high = (_describe_disparity(value_px, camera) for value_px in survey.range_px)
        return {"comment": f"disparity of the left view: {low} is blue, {high} is red{ending}"}
    if job.layout == "rgbd":
        return {"comment": f"disparity in grey: {low_px:.2f} px is black, {high_px:.2f} px is white"}
    return {}


def _divide(camera: StereoCamera, name: str, steps_per_px: int = 1) -> str:
    """Return the formula of depth in metres for a disparity of this name, in steps."""
    sign, offset = "-" if camera.doffs_px < 0 else "+", abs(camera.doffs_px * steps_per_px)
    shifted = f"({name} {sign} {offset:.6g})" if offset else name
    return f"{camera.focal_px * camera.baseline_m * steps_per_px:.6g} / {shifted}"


def _describe_disparity(disparity_px: float, camera: StereoCamera | None) -> str:
    text = f"{disparity_px:.2f} px"
    if camera is None:
        return text
    depth_m = float(camera.depth_m(np.array([[disparity_px]]))[0, 0])
    return f"{text} ({depth_m:.3g} m)" if isfinite(depth_m) else f"{text} (infinity)"
