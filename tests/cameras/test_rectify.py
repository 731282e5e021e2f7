from dataclasses import replace

import cv2
import numpy as np
import pytest
from rig_examples import (
    FOCAL_PX,
    SIZE_PX,
    Cameras,
    Plane,
    Sphere,
    fisheye,
    pinhole,
    project,
    rig_of,
    speckle,
    turned,
)

from stereoweave.cameras import rectify
from stereoweave.cameras.rig import Optics, Rig
from stereoweave.errors import FormatError, Note, StereoweaveError
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import StereoCamera, StereoPair

WALL_M = 5.0


@pytest.fixture(scope="module", params=[pinhole, fisheye])
def rig(request):
    return rig_of(request.param)


@pytest.fixture(scope="module")
def wall(rig):
    """Return the rectified pair of a textured wall that is 5 m away in every direction."""
    texture = speckle(np.random.default_rng(0))
    pair = Cameras(rig).photograph([Sphere(WALL_M)], texture, texel_m=0.009)
    return rectify.rectify(pair, rig)


def flat_rig(doffs_px=0.0):
    left = np.array([[500.0, 0, 310], [0, 500, 240], [0, 0, 1]])
    right = left + [[0, 0, doffs_px], [0, 0, 0], [0, 0, 0]]
    return Rig(
        left=Optics(matrix=left, distortion=np.zeros(0)),
        right=Optics(matrix=right, distortion=np.zeros(0)),
        rotation=np.eye(3),
        translation_m=np.array([-0.1, 0, 0]),
        size_px=SIZE_PX,
    )


def noise(rng, width_px=640, height_px=480):
    left, right = rng.integers(0, 256, (2, height_px, width_px, 3), dtype=np.uint8)
    return StereoPair(left=left, right=right)


def spots(at_px):
    """Return a black picture with a soft white spot at each place."""
    rows, columns = np.mgrid[: SIZE_PX[1], : SIZE_PX[0]]
    light = np.zeros(SIZE_PX[::-1])
    for x, y in at_px:
        light += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 1.5**2))
    return np.repeat(np.rint(250 * np.clip(light, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def spot_places(image):
    """Return x and y of the spots' centroids, sorted by row from the top."""
    _, labels, _, _ = cv2.connectedComponentsWithStats((image[..., 0] > 10).astype(np.uint8))
    rows, columns = np.mgrid[: SIZE_PX[1], : SIZE_PX[0]]
    light = image[..., 0].astype(float)
    return np.array(
        [
            ((light * columns)[labels == label].sum(), (light * rows)[labels == label].sum())
            / light[labels == label].sum()
            for label in range(1, labels.max() + 1)
        ]
    )


def test_points_of_a_crooked_rig_come_to_one_row_and_to_their_depth(rig, rng):
    # The points are at 2 to 8 m, and far enough apart that their spots do not touch.
    across, down = np.meshgrid(np.linspace(-0.4, 0.41, 9), np.linspace(-0.3, 0.31, 7))
    points_m = np.stack([across, down, np.ones_like(down)], axis=-1).reshape(-1, 3) * rng.uniform(
        2, 8, (63, 1)
    )
    left_px = project(rig.left, points_m)
    right_px = project(rig.right, points_m @ rig.rotation.T + rig.translation_m)
    assert np.median(np.abs(left_px - right_px)[:, 1]) > 3
    pair = rectify.rectify(StereoPair(left=spots(left_px), right=spots(right_px)), rig).pair
    left_px, right_px = spot_places(pair.left), spot_places(pair.right)
    assert len(left_px) == len(right_px) == 63
    # A spot's match is the only spot in its row whose disparity corresponds to 2 to 8 m.
    disparity_px = left_px[:, None, 0] - right_px[None, :, 0]
    near = (disparity_px > 5) & (disparity_px < 30) & (np.abs(left_px[:, None, 1] - right_px[None, :, 1]) < 5)
    assert (near.sum(axis=1) == 1).all()
    partner = near.argmax(axis=1)
    vertical_px = np.abs(left_px[:, 1] - right_px[partner, 1])
    assert np.median(vertical_px) < 0.03
    assert vertical_px.max() < 0.1
    # Rotating the left camera does not change distances from it.
    camera = pair.camera
    found_m = camera.depth_m((left_px[:, 0] - right_px[partner, 0])[None])[0]
    ideal = (left_px - (camera.cx_px, camera.cy_px)) / camera.focal_px
    found_m = np.sort(found_m * np.sqrt(1 + (ideal**2).sum(axis=1)))
    np.testing.assert_allclose(found_m, np.sort(np.linalg.norm(points_m, axis=1)), rtol=0.01)


def test_the_rectified_camera_keeps_the_resolution_of_the_middle(wall, rig):
    camera = wall.pair.camera
    assert camera.focal_px == pytest.approx(FOCAL_PX * 1.001)
    assert camera.baseline_m == pytest.approx(np.linalg.norm(rig.translation_m))
    assert camera.doffs_px == 0
    assert wall.pair.left.shape == (480, 640, 3)


def test_depth_of_a_wall_at_5_m_by_a_crooked_rig_is_true(wall):
    pair = wall.pair
    camera = pair.camera
    estimate = Matcher("small").estimate(pair.left, pair.right)
    rows, columns = np.mgrid[:480, :640]
    aside, down = (columns - camera.cx_px) / camera.focal_px, (rows - camera.cy_px) / camera.focal_px
    distance_m = camera.depth_m(estimate.disparity_px) * np.sqrt(1 + aside**2 + down**2)
    error_percent = 100 * np.abs(distance_m / WALL_M - 1)[(estimate.confidence > 0.5) & pair.left_seen]
    assert error_percent.size > 0.8 * distance_m.size
    assert np.median(error_percent) < 1
    assert np.percentile(error_percent, 90) < 4


def test_pixels_outside_the_source_are_masked_and_have_no_edge():
    # The left camera's rows are parallel to the baseline; the right camera is rotated about its optical axis.
    turn = turned(0, 0, 12)
    rig = replace(flat_rig(), rotation=turn, translation_m=-turn @ np.array([0.1, 0, 0]))
    grey = np.full((480, 640, 3), 90, np.uint8)
    rectified = rectify.rectify(StereoPair(left=grey, right=grey), rig).pair
    assert rectified.left_seen.mean() > 0.98
    assert 0.8 < rectified.right_seen.mean() < 0.95
    assert not rectified.right_seen[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert (rectified.left == 90).all() and (rectified.right == 90).all()


def test_no_ghost_of_the_border_is_seen_where_a_lens_polynomial_turns_back(rng):
    # k1 = -0.3 alone: the distorted radius r - 0.3 r^3 is largest at r = 1.054, which this picture exceeds.
    wide = Optics(
        matrix=np.array([[200.0, 0, 319.5], [0, 200, 239.5], [0, 0, 1]]), distortion=np.array([-0.3, 0, 0, 0])
    )
    rig = replace(flat_rig(), left=wide, right=wide)
    pair = rectify.rectify(noise(rng), rig).pair
    rows, columns = np.mgrid[:480, :640]
    radius = np.hypot(columns - 319.5, rows - 239.5) / 200
    assert not pair.left_seen[radius > 1.06].any()
    assert pair.left_seen[radius < 1.04].all()


def test_a_rectified_rig_gives_its_camera_and_leaves_the_pictures(rng):
    pair = noise(rng)
    rectified = rectify.rectify(pair, flat_rig(doffs_px=12))
    np.testing.assert_array_equal(rectified.pair.left, pair.left)
    assert rectified.pair.camera == StereoCamera(
        focal_px=500, baseline_m=0.1, cx_px=310, cy_px=240, doffs_px=12
    )
    assert "left unchanged" in rectified.notes[-1].text


def test_assumptions_and_changes_are_noted(wall, rig, rng):
    assert "rotated by" in wall.notes[-1].text
    assumed = Note("metres were assumed")
    notes = rectify.rectify(noise(rng), replace(rig, name="rig.yml", notes=(assumed,))).notes
    assert notes[0] == assumed and "rectified with rig.yml" in notes[1].text


@pytest.mark.parametrize(
    ("translation_m", "said"),
    [
        ((0.1, 0, 0), "left and right are swapped"),
        ((0, -0.1, 0), "below the left one"),
        ((0, 0.1, 0), "above the left one"),
        ((0.01, 0, 0.1), "in front of or behind"),
    ],
)
def test_cameras_that_are_not_side_by_side_are_refused(rng, translation_m, said):
    rig = replace(flat_rig(), translation_m=np.array(translation_m, float))
    with pytest.raises(StereoweaveError, match=said) as caught:
        rectify.rectify(noise(rng), rig)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("degrees", [90, 135, 180])
def test_cameras_that_look_different_ways_are_refused(rng, degrees):
    rotation = turned(0, degrees, 0)
    rig = replace(flat_rig(), rotation=rotation, translation_m=-rotation @ [0.1, 0, 0])
    with pytest.raises(StereoweaveError, match="expected two cameras that face the same way") as caught:
        rectify.rectify(noise(rng, 64, 48), replace(rig, size_px=None))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("degrees", "focal_px"), [(40, 2000), (70, 600)])
def test_cameras_without_a_common_view_are_refused(rng, degrees, focal_px):
    lens = Optics(
        matrix=np.array([[focal_px, 0, 320], [0, focal_px, 240], [0, 0, 1.0]]), distortion=np.zeros(0)
    )
    rotation = turned(0, degrees, 0)
    apart = replace(
        flat_rig(), left=lens, right=lens, rotation=rotation, translation_m=-rotation @ [0.1, 0, 0]
    )
    with pytest.raises(StereoweaveError, match="expected two cameras with a common view") as caught:
        rectify.rectify(noise(rng), apart)
    assert "\n" not in str(caught.value)


def test_a_lens_whose_model_divides_by_0_far_outside_of_the_picture_is_rectified(rng):
    """The denominator 1 + k4 r^2 of OpenCV's rational model is 0 at r = 10; the picture ends at r = 0.8."""
    lens = Optics(matrix=flat_rig().left.matrix, distortion=np.array([0, 0, 0, 0, 0, -0.01, 0, 0]))
    found = rectify.rectify(noise(rng), replace(flat_rig(), left=lens))
    assert found.pair.left_seen is not None
    assert found.pair.left_seen.mean() > 0.95


def test_a_focal_length_below_a_pixel_is_refused():
    with pytest.raises(StereoweaveError, match="focal lengths of at least 1 px"):
        Optics(matrix=np.diag([1e-320, 5.0, 1]), distortion=np.zeros(0))


def test_pictures_of_another_size_than_the_calibrations_are_refused(rng):
    with pytest.raises(FormatError, match="of 320x240, found one for 640x480"):
        rectify.rectify(noise(rng, 320, 240), flat_rig())


def test_a_plane_of_the_examples_is_hit_where_it_stands():
    plane = Plane(np.array([0, 0, 2.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), half_m=1)
    way_m, places_m = plane.hit(np.zeros(3), np.array([[0.0, 0.25, 1.0], [1.0, 0, 1.0]]))
    np.testing.assert_allclose(way_m, [2, np.inf])
    np.testing.assert_allclose(places_m[0], [0, 0.5])
