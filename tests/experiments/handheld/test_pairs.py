import cv2
import numpy as np
import pytest

from experiments.handheld.__main__ import main
from experiments.handheld.cameras import HandheldCamera, Ranges, Size, draw_cameras
from experiments.handheld.pairs import Original, take_again
from stereoweave.stereo import StereoPair

STILL = Ranges(
    turn_degrees=0,
    shift=0,
    scale=0,
    distortion=0,
    distortion_difference=0,
    exposure_stops=0,
    balance=0,
    noise_levels=0,
    quality=(100, 100),
)
SHARP = Ranges(exposure_stops=0, balance=0, noise_levels=0, quality=(100, 100))


@pytest.fixture(scope="module")
def original():
    """Soft noise at a disparity of 12 px everywhere."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (240, 332)), (0, 0), 2)
    grey = np.clip(128 + 8 * (noise - noise.mean()), 0, 255).astype(np.uint8)
    wide = np.repeat(grey[:, :, None], 3, axis=2)
    pair = StereoPair(left=wide[:, :-12].copy(), right=wide[:, 12:].copy())
    truth_px = np.full((240, 320), 12, np.float32)
    return Original(name="noise", pair=pair, truth_px=truth_px, focal_px=320.0)


def test_cameras_that_neither_move_nor_differ_take_the_original_again(original):
    made = take_again(original, 0, STILL)
    difference = np.abs(made.pair.left.astype(int) - original.pair.left)
    assert difference.mean() < 1.5  # of JPEG
    columns, rows = np.rint(made.left_px).astype(int).T
    np.testing.assert_allclose(made.left_px, np.column_stack([columns, rows]), atol=1e-6)
    np.testing.assert_allclose(made.right_px[:, 1], rows, atol=1e-6)
    np.testing.assert_allclose(made.left_px[:, 0] - made.right_px[:, 0], 12, atol=1e-6)


def test_a_turn_about_the_optical_axis_moves_a_place_around_the_centre():
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, np.pi / 2]))
    camera = HandheldCamera(
        turn=turn, focal_px=100.0, shift_px=np.zeros(2), distortion=0.0, original_focal_px=100.0
    )
    # 10 px right of the centre (50, 50) is 10 px below it in the original.
    found = camera.find_sources(np.array([[60.0, 50.0]]), Size(101, 101), Size(101, 101))
    np.testing.assert_allclose(found, [[50.0, 60.0]], atol=1e-9)


def test_places_and_sources_are_inverses(rng):
    size, original = Size(300, 200), Size(320, 240)
    for camera in draw_cameras(rng, Ranges(), original.width, 320.0):
        places_px = rng.uniform((0, 0), size, (50, 2))
        sources_px = camera.find_sources(places_px, size, original)
        assert np.abs(sources_px - places_px).max() > 1
        np.testing.assert_allclose(camera.find_places(sources_px, size, original), places_px, atol=1e-6)


@pytest.mark.parametrize("index", [0, 1])
def test_both_pictures_look_alike_at_correspondences_and_unlike_a_row_beside_them(original, index):
    made = take_again(original, index, SHARP)
    assert len(made.left_px) > 100
    left, right = (
        cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
        for image in (made.pair.left, made.pair.right)
    )

    def differences(rows_off: float) -> float:
        at_left = cv2.remap(left, made.left_px[:, None].astype(np.float32), None, cv2.INTER_LINEAR)
        places_px = (made.right_px + [0, rows_off])[:, None].astype(np.float32)
        return float(np.median(np.abs(at_left - cv2.remap(right, places_px, None, cv2.INTER_LINEAR))))

    assert differences(0) < 0.5 * min(differences(-0.5), differences(0.5))


def test_a_pair_depends_on_its_index_alone(original):
    made, again, other = (take_again(original, index) for index in (7, 7, 8))
    np.testing.assert_array_equal(made.pair.right, again.pair.right)
    np.testing.assert_array_equal(made.left_px, again.left_px)
    assert made.pair.left.shape != other.pair.left.shape or (made.pair.left != other.pair.left).any()


def test_the_pictures_keep_more_than_two_thirds_of_the_original_width(original):
    widths = [take_again(original, index).pair.left.shape[1] for index in range(10)]
    assert min(widths) > 320 * 2 / 3
    assert max(widths) < 320


def test_a_folder_without_pairs_is_refused_in_one_line(tmp_path, capsys):
    assert main([str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "expected <scene>/left.png below it" in capsys.readouterr().err
