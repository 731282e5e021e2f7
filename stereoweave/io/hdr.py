"""Tone mapping of HDR, and conversion of wide colours, of videos and pictures, to sRGB."""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

# Transfer functions and primaries by the numbers of ITU-T H.273, as FFmpeg and HEIC state them.
_PQ, _HLG = 16, 18
HDR = {_PQ: "PQ", _HLG: "HLG"}
"""Names of the transfer functions of HDR."""
_PRIMARIES_BT709, _PRIMARIES_BT2020, _PRIMARIES_P3 = 1, 9, 12

# Luminance of a white surface and of the brightest highlights (ITU-R BT.2408). The first becomes SDR's peak.
_WHITE_NITS, _PEAK_NITS = 203.0, 1000.0
_PQ_PEAK_NITS = 10_000.0
# Linear RGB of BT.2020 (ITU-R BT.2087), and of Display P3 (CSS Color 4), to that of BT.709.
_TO_BT709 = {
    _PRIMARIES_BT2020: np.array(
        [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
    ),
    _PRIMARIES_P3: np.array(
        [[1.2249, -0.2249, 0.0], [-0.0421, 1.0421, 0.0], [-0.0196, -0.0786, 1.0983]], np.float32
    ),
}
WIDE_COLOURS = frozenset(_TO_BT709)
"""Numbers of the primaries that `convert_primaries` converts."""
_LUMA_BT2020 = np.array([[0.2627, 0.6780, 0.0593]], np.float32)
# FFmpeg's conversion to 16-bit RGB makes this of white; it rounds to 65283.
WHITE_CODE = 255 * 256
_HLG_GAMMA = 1.2  # of a display with the peak above
_GAINS = 4096


def map_tones(
    codes: UInt16[np.ndarray, "h w 3"], transfer: int, primaries: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Return HDR as sRGB whose white is a white surface.

    The brightest channel of each pixel is compressed by the curve of ITU-R BT.2390, and the others in
    proportion, which keeps the hue. Colours outside BT.709 are clipped.

    Args:
        codes: RGB; white is `WHITE_CODE`.
        transfer: Number of the transfer function, one in `HDR`.
        primaries: Number of the primaries; unknown ones are taken for those of BT.2020.
    """
    light = _linear_table(transfer)[codes]
    if transfer == _HLG:
        luminance = cv2.transform(light, _LUMA_BT2020)
        light *= np.power(luminance, _HLG_GAMMA - 1)[..., None]
    # The fourth root spaces the entries about evenly in perceived brightness.
    steps = np.sqrt(np.sqrt(light.max(axis=2))) * (_GAINS - 1) + 0.5
    light *= _gain_table()[np.minimum(steps, _GAINS - 1).astype(np.uint16)][..., None]
    if primaries != _PRIMARIES_BT709:
        light = cv2.transform(light, _TO_BT709.get(primaries, _TO_BT709[_PRIMARIES_BT2020]))
    return _encode_srgb(light)


def convert_primaries(image: UInt8[np.ndarray, "h w 3"], primaries: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return an SDR image of these primaries as sRGB. Colours outside BT.709 are clipped.

    Primaries outside `WIDE_COLOURS` are taken for those of BT.709, from which the others hardly differ.
    """
    if primaries not in _TO_BT709:
        return image
    return _encode_srgb(cv2.transform(_light_of_srgb()[image], _TO_BT709[primaries]))


def _encode_srgb(light: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return _srgb_table()[(np.clip(light, 0, 1) * 65535 + 0.5).astype(np.uint16)]


@cache
def _light_of_srgb() -> Float32[np.ndarray, "256"]:
    codes = np.arange(256) / 255
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4).astype(np.float32)


@cache
def _linear_table(transfer: int) -> Float32[np.ndarray, "65536"]:
    """Return the light of each 16-bit code: of the display for PQ, of the scene for HLG; 1 is the peak."""
    codes = np.minimum(np.arange(65536) / WHITE_CODE, 1)
    if transfer == _PQ:
        return np.minimum(_decode_pq(codes) / _PEAK_NITS, 1).astype(np.float32)
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(codes <= 0.5, codes**2 / 3, (np.exp((codes - c) / a) + b) / 12).astype(np.float32)


@cache
def _gain_table() -> Float32[np.ndarray, "4096"]:
    """Return the factor from light relative to HDR's peak to light relative to SDR's, at fourth roots."""
    light = np.maximum(np.arange(_GAINS) / (_GAINS - 1), 0.5 / _GAINS) ** 4
    peak, white = _encode_pq(np.array([_PEAK_NITS, _WHITE_NITS]))
    code, most = _encode_pq(light * _PEAK_NITS) / peak, white / peak
    knee = 1.5 * most - 0.5
    t = np.maximum(code - knee, 0) / (1 - knee)
    spline = (
        (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    )
    nits = _decode_pq(np.where(code < knee, code, spline) * peak)
    return (nits / _WHITE_NITS / light).astype(np.float32)


@cache
def _srgb_table() -> UInt8[np.ndarray, "65536"]:
    light = np.arange(65536) / 65535
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * code).astype(np.uint8)


# SMPTE ST 2084.
_M1, _M2, _C1, _C2, _C3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875


def _encode_pq(nits: np.ndarray) -> np.ndarray:
    power = (nits / _PQ_PEAK_NITS) ** _M1
    return ((_C1 + _C2 * power) / (1 + _C3 * power)) ** _M2


def _decode_pq(code: np.ndarray) -> np.ndarray:
    power = code ** (1 / _M2)
    return _PQ_PEAK_NITS * (np.maximum(power - _C1, 0) / (_C2 - _C3 * power)) ** (1 / _M1)
