import numpy as np
import pytest
from hdr_examples import BT2020, PQ, nit_codes, srgb

from stereoweave.io.hdr import WHITE_CODE, map_tones


def shown(rgb_codes, transfer, primaries=BT2020):
    """Return what is shown of a pixel of non-linear RGB 0..1."""
    codes = np.round(np.array([[rgb_codes]]) * WHITE_CODE).astype(np.uint16)
    return map_tones(codes, transfer, primaries)[0, 0].astype(int).tolist()


@pytest.mark.parametrize("nits", [5, 26, 58, 90])
def test_luminance_below_the_knee_of_bt2390_is_kept(nits):
    # The knee is at 1.5 * 0.581 - 0.5 * 0.752 = 0.495 in PQ, 92 cd/m2; SDR's white is 203.
    assert shown(nit_codes(nits, nits, nits), PQ) == pytest.approx(3 * [srgb(nits / 203)], abs=1)


def test_highlights_are_compressed_up_to_1000_nits():
    greys = [shown(nit_codes(nits, nits, nits), PQ)[1] for nits in (90, 203, 400, 700, 1000, 4000)]
    assert greys == sorted(greys)
    assert greys[-2:] == [255, 255]
    # By hand, by the spline of BT.2390: 203 cd/m2 is PQ 0.5807, a share of 0.7724 of the range to 1000 cd/m2;
    # with the knee at 0.6586, t = 0.3333, so the share becomes 0.6586 * 0.7408 + 0.3414 * 0.1482 +
    # 0.7724 * 0.2592 = 0.7387, PQ 0.5554, 159 cd/m2: 0.784 of SDR's white.
    assert greys[1] == pytest.approx(srgb(0.784), abs=1)


@pytest.mark.parametrize(
    ("channel", "column"), [(0, (0.6274, 0.0691, 0.0164)), (2, (0.0433, 0.0114, 0.8956))]
)
def test_primaries_of_bt709_stay_pure(channel, column):
    # The columns are BT.709's red and blue in BT.2020 (BT.2087), here at 80 cd/m2.
    expected = [0, 0, 0]
    expected[channel] = srgb(80 / 203)
    assert shown(nit_codes(*(80 * share for share in column)), PQ) == pytest.approx(expected, abs=4)


def test_unknown_primaries_are_taken_for_those_of_bt2020():
    codes = nit_codes(80, 20, 20)
    assert shown(codes, PQ, primaries=2) == shown(codes, PQ, primaries=BT2020)
