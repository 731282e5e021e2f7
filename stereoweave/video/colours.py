"""Decoded frames as 8-bit sRGB: matrix, range and primaries of their colours; HDR is tone-mapped."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, UInt8

from stereoweave.io.hdr import HDR, WHITE_CODE, WIDE_COLOURS, convert_primaries, map_tones

if TYPE_CHECKING:
    import av

# As in players such as mpv, untagged colours are BT.709 from this width or height upwards, and BT.601 below.
_HD_WIDTH_PX, _HD_HEIGHT_PX = 1280, 577
_BT709, _BT601, _BT2020, _FULL_RANGE = 1, 5, 9, 2  # av.video.reformatter's Colorspace and ColorRange
_UNTAGGED = 0, 2  # AVCOL_SPC_RGB, which some encoders write for "unknown", and AVCOL_SPC_UNSPECIFIED

_PRIMARIES_BT2020 = 9

# To rgb48le, FFmpeg converts some dark colours of 4:2:0 wrongly.
_DEEP_RGB = "gbrp16le"


def convert_to_rgb(frame: "av.VideoFrame") -> UInt8[np.ndarray, "h w 3"]:
    """Return a frame upright, as sRGB. HDR is tone-mapped."""
    if frame.color_trc in HDR:
        picture = map_tones(_decode_rgb(frame, _DEEP_RGB), frame.color_trc, frame.color_primaries)
    else:
        picture = convert_primaries(_decode_rgb(frame, "rgb24"), frame.color_primaries)
    return np.ascontiguousarray(np.rot90(picture, frame.rotation // 90))


def convert_to_fine(frame: "av.VideoFrame") -> Float32[np.ndarray, "h w 3"]:
    """Return a frame upright, as RGB in the file's own colours, HDR too; black is 0 and white 255."""
    codes = _decode_rgb(frame, _DEEP_RGB).astype(np.float32)
    codes *= 255 / WHITE_CODE
    return np.ascontiguousarray(np.rot90(codes, frame.rotation // 90))


def name_hdr(frame: "av.VideoFrame") -> str | None:
    """Return the name of a frame's HDR transfer function, PQ or HLG; None for an ordinary frame."""
    return HDR.get(frame.color_trc)


def own_colours(frame: "av.VideoFrame") -> tuple[int, int, int] | None:
    """Return the primaries, transfer function and matrix of HDR and of wide colours, by FFmpeg's numbers.

    None for other frames. Primaries that an HDR file does not state are those of BT.2020.
    """
    if frame.color_trc in HDR:
        primaries = _PRIMARIES_BT2020 if frame.color_primaries in _UNTAGGED else frame.color_primaries
        return primaries, frame.color_trc, _BT2020
    if frame.color_primaries not in WIDE_COLOURS:
        return None
    transfer = _BT709 if frame.color_trc in _UNTAGGED else frame.color_trc
    return frame.color_primaries, transfer, _BT2020


def _decode_rgb(frame: "av.VideoFrame", format: str) -> np.ndarray:
    from av.video.reformatter import Interpolation

    return frame.to_ndarray(
        format=format,
        src_colorspace=_guess_matrix(frame) if frame.colorspace in _UNTAGGED else None,
        dst_color_range=_FULL_RANGE,
        # Without the last two flags, FFmpeg's fast path from 4:2:0 darkens images by over one level of 255.
        interpolation=Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT,
        threads=1,
    )


def _guess_matrix(frame: "av.VideoFrame") -> int:
    if frame.color_trc in HDR:
        return _BT2020
    return _BT709 if frame.width >= _HD_WIDTH_PX or frame.height >= _HD_HEIGHT_PX else _BT601
