from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from experiments.sphere_windows.room import (
    cast,
    look_equirectangular,
    look_fisheye,
    render_fixed,
    render_turning,
)
from stereoweave.cameras.sphere_remap import Cutter, Spreader
from stereoweave.cameras.sphere_windows import make_whole_window, make_window
from stereoweave.cameras.spherical import Projection, SphereRequest
from stereoweave.errors import StereoweaveError

HALF = Projection.named("half_equirectangular")
FULL = Projection.named("equirectangular")


def rays_of(*directions):
    return np.array(directions, np.float32).T[:, None]


def find_pixel(projection, size_px, direction):
    found = projection.locate(rays_of(direction), size_px)
    return float(found.columns[0, 0]), float(found.rows[0, 0]), bool(found.seen[0, 0])


def test_an_equirectangular_image_shows_its_angles_evenly():
    # 360 columns: one a degree; the pixel of yaw 0 to 1 is number 180, and its centre is at half a degree.
    assert find_pixel(FULL, (360, 180), (0, 0, 1)) == pytest.approx((179.5, 89.5, True))
    assert find_pixel(FULL, (360, 180), (1, 0, 0)) == pytest.approx((269.5, 89.5, True))
    assert find_pixel(FULL, (360, 180), (0, -1, 1)) == pytest.approx((179.5, 44.5, True))
    assert find_pixel(HALF, (180, 180), (1, 0, 1)) == pytest.approx((134.5, 89.5, True))
    assert not find_pixel(HALF, (180, 180), (0, 0, -1))[2]


def test_a_fisheye_shows_angles_from_its_axis_evenly():
    fisheye = Projection.named("fisheye", 190.0)
    # 95 degrees are 100 px from the centre at 99.5.
    assert find_pixel(fisheye, (200, 200), (1, 0, 0)) == pytest.approx((99.5 + 100 * 90 / 95, 99.5, True))
    assert find_pixel(fisheye, (200, 200), (0, 1, 1)) == pytest.approx((99.5, 99.5 + 100 * 45 / 95, True))
    assert not find_pixel(fisheye, (200, 200), (0, -1, -0.2))[2]  # 101 degrees from the axis


@pytest.mark.parametrize("look_deg", [(0, 0), (40, 0), (-30, 25), (0, -60)])
def test_rays_of_a_window_lead_back_to_its_pixels(look_deg):
    for window in (make_window(HALF, (300, 300), look_deg, 60), make_window(FULL, (600, 300), (170, 10), 60)):
        columns, rows = window.find(window.rays())
        np.testing.assert_allclose(
            columns, np.broadcast_to(np.arange(columns.shape[1]), rows.shape), atol=0.01
        )
        np.testing.assert_allclose(rows.T, np.broadcast_to(np.arange(rows.shape[0]), rows.T.shape), atol=0.01)


def test_a_window_straight_ahead_is_as_sharp_as_the_picture():
    window = make_window(HALF, (1800, 1800), (0, 0), 90)
    # 10 px a degree are 573 px a radian, and 90 degrees are two focal lengths wide.
    assert window.focal_px == pytest.approx(1800 / np.pi)
    assert window.size_px == (1146, 1146)
    camera = window.camera(0.063)
    assert camera and (camera.cx_px, camera.cy_px) == (572.5, 572.5)


def test_a_window_aside_lies_on_the_plane_of_the_baseline():
    window = make_window(HALF, (1800, 1800), (45, 0), 60)
    # From 15 to 75 degrees: the middle of the plane is far to the left of the window.
    columns, rows = window.find(rays_of((np.sin(np.pi / 12), 0, np.cos(np.pi / 12))))
    assert columns[0, 0] == pytest.approx(0, abs=1.5)
    assert rows[0, 0] == pytest.approx((window.size_px[1] - 1) / 2)


@pytest.mark.parametrize("look_deg", [(0, 0), (35, 0), (-20, 30)])
def test_rows_of_a_fixed_pair_match_in_any_window(look_deg):
    window = make_window(HALF, (400, 400), look_deg, 60)
    points = np.random.default_rng(1).uniform(-1, 1, (40, 3)) * (2, 2, 2) + (0, 0, 6)
    left, right = (rays_of(*(points - (side, 0, 0))) for side in (-0.5, 0.5))
    (left_columns, left_rows), (right_columns, right_rows) = window.find(left), window.find(right)
    np.testing.assert_allclose(left_rows, right_rows, atol=1e-3)
    assert (left_columns > right_columns).all()


@pytest.mark.parametrize("look_deg", [(0, 0), (135, 0), (-90, 20)])
def test_rows_of_eyes_that_turn_match_in_any_window(look_deg):
    window = make_window(FULL, (800, 400), look_deg, 60)
    yaw, radius, height = np.radians(look_deg[0] + 12), 5.0, -1.5
    # From eyes on a circle, the point is asin(0.5 / 5) to the right and left of its yaw.
    parallax = np.arcsin(0.5 / radius)
    level = np.sqrt(radius**2 - 0.25)
    angles = yaw + parallax, yaw - parallax
    rays = [(level * np.sin(angle), height, level * np.cos(angle)) for angle in angles]
    columns, rows = window.find(rays_of(*rays))
    assert rows[0, 0] == pytest.approx(rows[0, 1], abs=1e-3)
    disparity_px = np.zeros((window.size_px[1], window.size_px[0]), np.float32)
    row, column = round(float(rows[0, 0])), round(float(columns[0, 0]))
    disparity_px[row, column] = columns[0, 0] - columns[0, 1]
    expected = 1 / np.hypot(level, height)
    assert window.nearness(disparity_px)[row, column] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("whole", [True, False])
def test_exact_disparities_give_exact_distances(whole):
    window = make_whole_window(HALF, (200, 200)) if whole else make_window(HALF, (200, 200), (20, 10), 70)
    rays = np.moveaxis(window.rays().astype(float), 0, -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    _, distance = cast(rays, np.array([-0.5, 0, 0]))
    points = distance[..., None] * rays - (1, 0, 0)  # as the right eye sees them
    columns, _ = window.find(np.moveaxis(points, -1, 0).astype(np.float32))
    disparity_px = np.arange(window.size_px[0]) - columns
    aside_deg = window.blindness_deg(np.moveaxis(rays, -1, 0).astype(np.float32))
    seen = (aside_deg < 75) & (disparity_px > 0)
    found = 1 / window.nearness(disparity_px.astype(np.float32))[seen]
    np.testing.assert_allclose(found, distance[seen], rtol=0.01)


def test_both_eyes_of_a_window_show_the_same_rows_of_a_room():
    scene = render_fixed(look_equirectangular((256, 256)))
    window = make_window(HALF, (256, 256), (0, 0), 90)
    cutter = Cutter(HALF, (256, 256), window)
    assert cutter.seen is None
    rays = np.moveaxis(window.rays().astype(float), 0, -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    expected, _ = cast(rays, np.array([-0.5, 0, 0]))
    error = np.abs(cutter.cut(scene.left).astype(float) - expected)
    assert error.mean() < 4  # of 255; the texture is finer than a pixel in places


def test_a_window_across_the_seam_of_a_360_degree_picture_is_continuous():
    scene = render_turning((512, 256))
    window = make_window(FULL, (512, 256), (180, 0), 60)
    image = Cutter(FULL, (512, 256), window).cut(scene.left).astype(float)
    steps = np.abs(np.diff(image, axis=1)).mean(axis=(0, 2))
    middle = window.size_px[0] // 2
    assert steps[middle - 2 : middle + 2].max() < 1.5 * np.median(steps)


def project_by_ffmpeg(image, options):
    """Return an equirectangular image in another projection, by FFmpeg's filter v360."""
    graph = av.filter.Graph()
    first = graph.add_buffer(
        width=image.shape[1], height=image.shape[0], format="rgb24", time_base=Fraction(1, 25)
    )
    graph.link_nodes(first, graph.add("v360", options), graph.add("buffersink")).configure()
    frame = av.VideoFrame.from_ndarray(image, "rgb24")
    frame.pts, frame.time_base = 0, Fraction(1, 25)
    graph.push(frame)
    return graph.vpull().to_ndarray(format="rgb24")


@pytest.mark.parametrize(
    ("projection", "options"),
    [
        (Projection.named("fisheye", 190.0), "e:fisheye:h_fov=190:v_fov=190:w=512:h=512:interp=cubic"),
        (HALF, "e:hequirect:w=512:h=512:interp=cubic"),
    ],
)
def test_ffmpeg_projects_as_we_do(projection, options):
    image, _ = cast(look_equirectangular((1024, 512), 360.0), np.array([0.0, 0, 0]))
    image = cv2.GaussianBlur(image, (0, 0), 2)
    projected = project_by_ffmpeg(image, options)
    window = make_window(HALF, (512, 512), (30, -20), 60)
    expected = Cutter(FULL, (1024, 512), window).cut(image).astype(float)
    found = Cutter(projection, (512, 512), window).cut(projected)
    assert np.abs(found - expected).mean() < 1.5
    moved = np.roll(expected, 1, axis=1)
    assert np.abs(moved - expected)[:, 1:].mean() > 3  # a pixel aside would differ more


def test_what_a_fisheye_does_not_show_is_black_and_marked():
    window = make_window(Projection.named("fisheye", 80.0), (128, 128), (0, 0), 90)
    cutter = Cutter(Projection.named("fisheye", 80.0), (128, 128), window)
    image = cutter.cut(np.full((128, 128, 3), 200, np.uint8))
    assert cutter.seen is not None and not cutter.seen[0, 0] and cutter.seen[window.size_px[1] // 2, 60]
    assert not image[~cutter.seen].any() and (image[cutter.seen] == 200).all()


def test_the_whole_of_a_picture_spreads_back_to_it():
    rays = look_fisheye(300, 190.0)
    image, _ = cast(rays, np.array([0.0, 0, 0]))
    fisheye = Projection.named("fisheye", 190.0)
    window = make_whole_window(fisheye, (300, 300))
    arc = Cutter(fisheye, (300, 300), window).cut(image)
    back = Spreader(window, HALF, (300, 300)).spread(arc)
    expected, _ = cast(look_equirectangular((300, 300)), np.array([0.0, 0, 0]))
    assert np.abs(back.astype(float) - expected)[60:240].mean() < 12


@pytest.mark.parametrize(
    ("projection", "look_deg", "fov_deg", "found"),
    [
        (
            HALF,
            (0, 0),
            5,
            "expected 10 to 150 degrees, found 5; for more, take the whole field of view (whole)",
        ),
        (HALF, (0, 0), float("nan"), "found nan"),
        (HALF, (60, 0), 60, "look less far aside, or narrow the field of view (look_deg, fov_deg)"),
        (HALF, (0, 120), 60, "a pitch of -90 to 90 degrees, found 0,120"),
        (HALF, (float("inf"), 0), 60, "found inf,0"),
        (FULL, (0, 70), 60, "one of up to 100"),
    ],
)
def test_a_window_where_nothing_can_be_matched_is_refused(projection, look_deg, fov_deg, found):
    with pytest.raises(StereoweaveError) as error:
        make_window(projection, (400, 200), look_deg, fov_deg)
    assert found in str(error.value) and "\n" not in str(error.value)


def test_a_window_of_too_few_or_too_many_pixels_is_refused():
    for size_px in ((40, 20), (60_000, 30_000)):
        with pytest.raises(StereoweaveError, match="choose another field of view"):
            make_window(FULL, size_px, (0, 0), 60)


def test_settings_of_a_sphere_need_a_projection():
    with pytest.raises(
        StereoweaveError, match="choose one of equirectangular, half_equirectangular, fisheye"
    ):
        SphereRequest(look_deg=(0, 0)).choose("a.jpg", None)
    with pytest.raises(StereoweaveError, match="rectilinear, equirectangular, half_equirectangular, fisheye"):
        SphereRequest(projection="cubemap")
    with pytest.raises(StereoweaveError, match="expected only for a fisheye"):
        SphereRequest(projection="equirectangular", lens_fov_deg=190)
    with pytest.raises(StereoweaveError, match="expected a field of view of 20 to 280 degrees, found 500"):
        SphereRequest(projection="fisheye", lens_fov_deg=500).choose("a.jpg", None)
    assert SphereRequest(projection="rectilinear").choose("a.jpg", HALF) is None
    assert SphereRequest().choose("a.jpg", HALF) is HALF


@pytest.mark.parametrize(
    ("projection", "eye_size_px"),
    [
        (Projection(name="half_equirectangular", yaw_deg=(-0.5, 0.5), pitch_deg=(-0.5, 0.5)), (64, 64)),
        (Projection(name="half_equirectangular", yaw_deg=(-0.5, 0.5)), (64, 64)),
        (Projection(name="equirectangular", pitch_deg=(-0.5, 0.5)), (128, 64)),
        (Projection.named("fisheye", 20.0), (200, 200)),
    ],
)
def test_a_part_of_few_degrees_opens_no_window_of_far_more_pixels(projection, eye_size_px):
    # 64 px a degree are 3667 px a radian, and 90 degrees are two focal lengths wide.
    with pytest.raises(StereoweaveError, match="at most 16 times the picture's pixels, found") as error:
        make_window(projection, eye_size_px, (0, 0), 90)
    assert str(error.value).endswith("; choose a narrower field of view (fov_deg)")
    with pytest.raises(StereoweaveError, match="at most 16 times the picture's pixels, found|65 megapixels"):
        make_whole_window(projection, eye_size_px)


def test_the_widest_window_of_a_vr180_picture_of_half_width_is_allowed():
    window = make_window(HALF, (200, 400), (5, 0), 150)
    # 127 px of focal length: tan 80 + tan 70 wide, and 2 tan 75 / cos 5 high.
    assert window.size_px == (1072, 954)
