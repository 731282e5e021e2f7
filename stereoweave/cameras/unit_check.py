"""Notes on a camera whose focal length or baseline is probably in a wrong unit."""

import math

from stereoweave.errors import Note, Remedy
from stereoweave.stereo import StereoCamera

# Stereo cameras and rigs are within these limits. Windows of VR180 pictures have views of up to 150 degrees.
_LEAST_BASELINE_M, _MOST_BASELINE_M = 0.001, 5.0
_WIDEST_DEGREES = 155.0


def note_units(camera: StereoCamera, width_px: int) -> list[Note]:
    """Return a note for a baseline under 1 mm or over 5 m, and for a field of view over 155 degrees.

    Args:
        camera: Camera of a rectified pair.
        width_px: Width of the pair's pictures.
    """
    notes = []
    if not _LEAST_BASELINE_M <= camera.baseline_m <= _MOST_BASELINE_M:
        check = Remedy("check the unit of the baseline", ("calibration", "baseline_m"))
        notes.append(Note(f"unlikely depths in metres: the cameras are {_name_length(camera)} apart", check))
    view_degrees = 2 * math.degrees(math.atan(width_px / (2 * camera.focal_px)))
    if view_degrees > _WIDEST_DEGREES:
        check = Remedy("check that the focal length is in pixels", ("calibration", "focal_px"))
        text = f"a focal length of {camera.focal_px:g} px means a field of view of {view_degrees:.0f} degrees"
        notes.append(Note(f"unlikely depths in metres: {text}", check))
    return notes


def _name_length(camera: StereoCamera) -> str:
    metres = camera.baseline_m
    return f"{metres:.1f} m" if metres > _MOST_BASELINE_M else f"{1000 * metres:.2f} mm"
