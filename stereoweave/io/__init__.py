"""Reading and writing pictures, maps and other files on disk and in object stores."""

from stereoweave.io.images import read_image, read_pair, write_image
from stereoweave.io.maps import (
    RangeError,
    read_disparity_png,
    read_pfm,
    write_depth_png,
    write_disparity_png,
    write_float_tiff,
    write_npy,
    write_pfm,
    write_scaled_disparity_png,
)

__all__ = [
    "RangeError",
    "read_disparity_png",
    "read_image",
    "read_pair",
    "read_pfm",
    "write_depth_png",
    "write_disparity_png",
    "write_float_tiff",
    "write_image",
    "write_npy",
    "write_pfm",
    "write_scaled_disparity_png",
]
