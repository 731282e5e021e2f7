import cv2
import numpy as np
import pytest

from stereoweave.cameras.picture_warp import PictureWarp, undistort

SIZE = 160, 120


@pytest.fixture
def warp():
    turn = np.array([[1.02, 0.05, -4.0], [-0.04, 0.98, 3.0], [1e-4, -5e-5, 1.0]])
    return PictureWarp(homography=turn, distortion=0.04, size_px=SIZE)


def test_the_corner_moves_by_the_distortion_and_the_centre_stays():
    centre, corner = np.array([[79.5, 59.5]]), np.array([[79.5 + 80, 59.5 + 60]])
    np.testing.assert_allclose(undistort(centre, 0.25, SIZE), centre)
    # At half the diagonal, 100 px, the distance becomes 100 / 1.25.
    np.testing.assert_allclose(undistort(corner, 0.25, SIZE), [[79.5 + 64, 59.5 + 48]])


@pytest.mark.parametrize("distortion", [-0.04, 0.0, 0.04])
def test_pixels_go_where_points_go(warp, distortion):
    warp = PictureWarp(homography=warp.homography, distortion=distortion, size_px=SIZE)
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    image = np.stack([columns, rows, np.full_like(rows, 7)], axis=2).astype(np.uint8)
    warped, seen = warp.apply(image, None)
    places = np.array([[50.0, 40.0], [80.0, 60.0], [120.0, 90.0], [30.0, 100.0]])
    there = warp.transform(places).astype(np.float32)
    assert cv2.remap(255 * seen.astype(np.uint8), there[:, None], None, cv2.INTER_LINEAR).min() == 255
    shown = cv2.remap(warped, there[:, None], None, cv2.INTER_LINEAR)[:, 0, :2]
    np.testing.assert_allclose(shown, places, atol=1)


def test_pixels_from_outside_the_picture_are_masked_and_repeat_the_border(warp):
    image = np.full((*SIZE[::-1], 3), 50, np.uint8)
    warped, seen = warp.shifted((30.0, 0.0)).apply(image, None)
    assert not seen[:, :20].any()
    assert seen[20:-20, 60:-20].all()
    assert (warped == 50).all()


def test_a_shift_follows_the_warp(warp):
    places = np.array([[50.0, 40.0], [80.0, 60.0]])
    np.testing.assert_allclose(
        warp.shifted((3.0, -2.0)).transform(places), warp.transform(places) + [3, -2], atol=1e-9
    )
