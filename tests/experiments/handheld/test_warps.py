import cv2
import numpy as np
import pytest

from experiments.handheld.pairs import HandheldPair
from experiments.handheld.scoring import SwapRow, WarpedRow, summarize_swaps, summarize_warped
from experiments.handheld.warps import rolling_shutter, warp_in_each_way, warped_print, wide_lens
from stereoweave.stereo import StereoPair

SIZE = (321, 241)
NAMES = ["wide_lens_0.15", "wide_lens_0.3", "wide_lens_0.45", "rolling_shutter", "warped_print"]


@pytest.fixture(scope="module")
def made():
    """Soft noise at a disparity of 12 px everywhere."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (241, 333)), (0, 0), 3)
    grey = np.clip(128 + 12 * (noise - noise.mean()), 0, 255).astype(np.uint8)
    wide = np.repeat(grey[:, :, None], 3, axis=2)
    left_px = np.random.default_rng(1).uniform((40, 30), (280, 210), (200, 2))
    return HandheldPair(
        name="noise",
        pair=StereoPair(left=wide[:, :-12].copy(), right=wide[:, 12:].copy()),
        left_px=left_px,
        right_px=left_px - [12, 0],
    )


def test_a_wide_lens_keeps_the_corners_and_enlarges_the_middle():
    # At the centre a step of 1 px is one of 1 - 0.3 px in the original.
    places_px = np.array([[0.0, 0.0], [160.0, 120.0], [161.0, 120.0]])
    found_px = wide_lens(SIZE, 0.3)(places_px)
    np.testing.assert_allclose(found_px[0], [0, 0], atol=1)
    np.testing.assert_allclose(found_px[2] - found_px[1], [0.7, 0], atol=1e-4)


def test_rows_of_a_rolling_shutter_sway_with_a_phase():
    places_px = np.array([[10.0, 0.0]])
    np.testing.assert_allclose(rolling_shutter(SIZE, 3.0)(places_px), [[10, 0]])
    np.testing.assert_allclose(rolling_shutter(SIZE, 3.0, np.pi / 2)(places_px), [[10, 3]])


def test_a_warped_print_moves_places_by_at_most_the_amplitude_in_both_directions(rng):
    rows, columns = np.mgrid[0:241:10, 0:321:10]
    places_px = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    moved_px = np.abs(warped_print(SIZE, 3.0, rng)(places_px) - places_px)
    assert (moved_px.max(0) <= 3).all()
    assert (moved_px.max(0) > 0.5).all()


@pytest.mark.parametrize("name", NAMES)
def test_distorted_pictures_look_alike_at_the_moved_correspondences(made, name):
    warped = dict(warp_in_each_way(made, 0))
    assert list(warped) == NAMES
    found = warped[name]
    assert len(found.left_px) > 60
    # Without the distortion, all places differ by 12 px along the row.
    assert np.ptp(found.left_px - found.right_px, axis=0).max() > 0.3
    left, right = (
        cv2.remap(image, at_px[:, None].astype(np.float32), None, cv2.INTER_LINEAR).astype(float)
        for image, at_px in ((found.pair.left, found.left_px), (found.pair.right, found.right_px))
    )
    assert np.abs(left - right).mean() < 2


def test_summaries_count_each_distortion_and_both_kinds_of_swaps():
    row = {"pair": "a", "width_px": 8, "height_px": 8, "vertical_error_before_px": 3.0}
    rows = [
        WarpedRow(**row, vertical_error_px=0.4, lost_percent=5, warp="print"),
        WarpedRow(**row, vertical_error_px=0.6, lost_percent=5, warp="print"),
    ]
    assert summarize_warped(rows) == "print: 1 of 2 pairs end under 0.5 px, and 1 of these lose at most 10 %"
    swaps = [SwapRow(pair=name, swapped_falsely=False, swap_found=name == "a") for name in "abc"]
    assert summarize_swaps(swaps) == "0 of 3 sound pairs are swapped, and 1 of 3 swapped ones"
