"""Camera raw files (Adobe DNG 1.4) that tifffile writes: a Bayer pattern and what is needed to develop it."""

from pathlib import Path

import numpy as np
import tifffile

# Tags of TIFF, EXIF and DNG.
ORIENTATION, MODEL, FOCAL_35_MM = 274, 272, 41989
_CFA_PATTERN = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2))  # row, column, colour
# From XYZ to linear sRGB: a camera whose colours are those of sRGB.
_XYZ_TO_SRGB = 3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570


def write_dng(path: Path, linear: np.ndarray, *, orientation: int = 1, neutral=(1.0, 1.0, 1.0)) -> Path:
    """Write linear RGB [H, W, 3] in 0..1 as seen by a sensor, one colour for each pixel.

    Args:
        path: File to write.
        linear: Light at each pixel.
        orientation: EXIF orientation.
        neutral: What the camera records for white.
    """
    sensor = np.empty(linear.shape[:2], np.uint16)
    for row, column, colour in _CFA_PATTERN:
        values = linear[row::2, column::2, colour] * neutral[colour]
        sensor[row::2, column::2] = np.rint(65535 * values)
    matrix = [part for value in _XYZ_TO_SRGB for part in (round(10_000 * value), 10_000)]
    white = [part for value in neutral for part in (round(1000 * value), 1000)]
    tags = [
        (271, "s", 0, "Test"),
        (MODEL, "s", 0, "Test camera"),
        (ORIENTATION, "H", 1, orientation),
        (33421, "H", 2, (2, 2)),
        (33422, "B", 4, (0, 1, 1, 2)),
        (50706, "B", 4, (1, 4, 0, 0)),
        (50708, "s", 0, "Test camera"),
        (50717, "H", 1, 65535),
        (50721, "2i", 9, matrix),
        (50728, "2I", 3, white),
        (50778, "H", 1, 21),  # daylight, D65
    ]
    tifffile.imwrite(path, sensor, photometric=32803, extratags=tags, software=False, metadata=None)
    return path


def linear_of(image: np.ndarray) -> np.ndarray:
    """Return the light, 0..1, of an image in sRGB."""
    values = image / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
