"""Codes of HDR, by numbers of ITU-T H.273, and what is shown of them."""

import numpy as np

PQ, HLG, BT2020, BT709 = 16, 18, 9, 1


def nit_codes(*rgb_nits: float) -> np.ndarray:
    """Return the PQ codes of three luminances (SMPTE ST 2084)."""
    power = (np.array(rgb_nits) / 10_000) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)


def srgb(light: float) -> int:
    """Return the code of light above 0.003, of which 1 is white."""
    return round(255 * (1.055 * light ** (1 / 2.4) - 0.055))
