"""Maps of disparity or depth, and masks, as PFM, 16-bit PNG and TIFF."""

from functools import partial
from pathlib import Path

import numpy as np

from fuzz.repairs import repair_png
from fuzz.targets import Target, read_every_way, write_to_bytes
from fuzz.targets.pictures import encode_picture
from stereoweave.io.maps import read_disparity_png, read_pfm, read_pixels, write_disparity_png, write_pfm


def _starts() -> dict[str, bytes]:
    values = np.linspace(0, 30, 12 * 16, dtype=np.float32).reshape(12, 16)
    values[3, 4:6] = np.nan, np.inf
    steps = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)
    return {
        "map.pfm": write_to_bytes("map.pfm", partial(write_pfm, values=values)),
        "big_endian.pfm": b"Pf\n16 12\n1.0\n" + values.astype(">f4").tobytes(),
        "map.png": write_to_bytes("map.png", partial(write_disparity_png, disparity_px=values)),
        "mask.png": encode_picture(steps.astype(np.uint8), "PNG"),
        "float.tiff": encode_picture(np.nan_to_num(values, posinf=1), "TIFF"),
        "deep.tiff": encode_picture(steps, "TIFF"),
    }


def _read(path: Path) -> None:
    read_every_way(
        partial(read_pfm, path),
        partial(read_disparity_png, path),
        partial(read_pixels, path, "L", "I;16", "RGB", "F"),
    )


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(b"Pf\n", b"PF\n", b"-1.0\n", b"99999 99999\n", *b"IHDR IDAT II*\0 MM\0*".split()),
    repair=repair_png,
)
