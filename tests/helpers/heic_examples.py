"""HEIC files that pillow-heif writes."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pillow_heif import HeifFile

# RGB as it is, without loss. pillow-heif applies it to the primary image; others are off by up to a level.
LOSSLESS = {"quality": -1, "chroma": 444, "matrix_coefficients": 0}


def write_heic(
    path: Path,
    *images: np.ndarray,
    icc_profile: bytes | None = None,
    exif: Image.Exif | None = None,
    **options: Any,
) -> Path:
    """Write images of 8 bits (see `LOSSLESS`); with an EXIF orientation, as a camera that lay so would."""
    file = HeifFile()
    for image in map(Image.fromarray, images):
        added = file.add_frombytes(image.mode, image.size, image.tobytes())
        tags = {"icc_profile": icc_profile, "exif": None if exif is None else exif.tobytes()}
        added.info |= {key: value for key, value in tags.items() if value}
    file.save(path, **LOSSLESS | options)
    return path
