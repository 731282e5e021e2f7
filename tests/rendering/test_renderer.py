import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from other_processes import UNMEASURED
from plain_rendering import plain_rendering, plain_splat

import stereoweave
from stereoweave.rendering.canvas_kernels import NOTHING, splat
from stereoweave.rendering.renderer import Renderer, render
from stereoweave.stereo import Estimate, StereoPair

BACKGROUND = np.array([40, 120, 200], np.uint8)
OBJECT = np.array([250, 30, 10], np.uint8)


def make_estimate(disparity_px, right_disparity_px, confidence=None):
    if confidence is None:
        confidence = np.ones(disparity_px.shape, np.float32)
    return Estimate(
        disparity_px=disparity_px.astype(np.float32),
        right_disparity_px=right_disparity_px.astype(np.float32),
        confidence=confidence.astype(np.float32),
        # If no pixel is seen by both cameras, the exposures are not matched; tests check exact levels.
        occluded=np.ones(disparity_px.shape, bool),
    )


def wall_with_object(object_columns, height=5, width=40):
    """Return a pair and its estimate: a plain wall at disparity 2, an object at 10 in these left columns."""
    photos, maps = [], []
    for shift in (0, -10):
        photo = np.tile(BACKGROUND, (height, width, 1))
        disparity_px = np.full((height, width), 2.0)
        columns = slice(object_columns.start + shift, object_columns.stop + shift)
        photo[:, columns] = OBJECT
        disparity_px[:, columns] = 10
        photos.append(photo)
        maps.append(disparity_px)
    return *photos, make_estimate(*maps)


def random_scene(rng, *, lowest_px=0.0, height=14, width=40):
    """Return a pair of noise and an estimate whose maps partly agree: slants, edges, sticks and errors."""
    columns = np.arange(width)
    maps = []
    for sign in (1, -1):
        disparity_px = lowest_px + rng.uniform(0, 3) + rng.uniform(-0.2, 0.2, (height, 1)) * columns
        for size, nearer_px in ((12, 6.0), (5, 9.0), (1, 12.0), (1, 3.5)):
            x = rng.integers(0, width - size, height)[:, None] - sign * 2
            disparity_px = np.where(
                (columns >= x) & (columns < x + size), lowest_px + nearer_px, disparity_px
            )
        disparity_px += rng.normal(0, 0.3, (height, width))
        disparity_px[rng.random((height, width)) < 0.02] += 15
        maps.append(disparity_px)
    left, right = rng.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    return left, right, make_estimate(*maps, confidence=rng.random((height, width)))


def test_halfway_between_the_cameras_a_wall_moves_by_half_its_disparity(rng):
    wide = rng.integers(0, 256, (8, 46, 3), dtype=np.uint8)
    left, right = wide[:, :40], wide[:, 6:]  # column x of the left image is at x - 6 in the right one
    view = render(left, right, make_estimate(*np.full((2, 8, 40), 6.0)), 0.5)
    np.testing.assert_array_equal(view.image, wide[:, 3:43])
    assert view.drawn.all()


@pytest.mark.parametrize("position", [0.25, 0.75, 1.25, -0.25])
def test_a_slanted_ramp_of_grey_is_where_its_disparity_says(position):
    # d = 4 + x / 8: column x of the left image, of grey level 3 x, is at u = x - position (4 + x / 8).
    columns = np.arange(64.0)
    to_left_column = lambda u, at: (u + 4 * at) / (1 - at / 8)  # noqa: E731
    photos = [np.clip(np.rint(3 * to_left_column(columns, at)), 0, 255).astype(np.uint8) for at in (0, 1)]
    left, right = (np.repeat(np.tile(photo, (6, 1))[..., None], 3, 2) for photo in photos)
    maps = [np.tile(4 + to_left_column(columns, at) / 8, (6, 1)) for at in (0, 1)]
    view = render(left, right, make_estimate(*maps), position)
    expected = 3 * to_left_column(columns, position)
    inside = view.drawn[0] & (expected < 190) & (expected > 0)
    assert inside.sum() > 40
    assert np.abs(view.image[3, inside, 1] - expected[inside]).max() <= 1


@pytest.mark.parametrize("position", [0, 1])
def test_at_a_camera_the_view_is_its_image(rng, position):
    left, right, estimate = random_scene(rng)
    view = render(left, right, estimate, position)
    np.testing.assert_array_equal(view.image, (left, right)[position])
    assert view.drawn.all()


@pytest.mark.parametrize(("camera", "position"), [(0, 1e-3), (0, -1e-3), (1, 1 - 1e-3), (1, 1 + 1e-3)])
def test_next_to_a_camera_the_view_is_nearly_its_image(rng, camera, position):
    left, right, estimate = random_scene(rng)
    view = render(left, right, estimate, position)
    apart = np.abs(view.image.astype(int) - (left, right)[camera])
    # A disparity of 15 px moves by 0.015 px, and the other image has a weight of a thousandth.
    assert np.median(apart) <= 1
    assert view.drawn.mean() > 0.99


def test_an_object_lands_where_its_disparity_says_and_hides_the_wall():
    left, right, estimate = wall_with_object(slice(20, 26))
    view = render(left, right, estimate, 0.5)
    # Columns 20..25 move left by 0.5 * 10.
    np.testing.assert_array_equal(view.image[:, 15:21], np.broadcast_to(OBJECT, (5, 6, 3)))
    np.testing.assert_array_equal(view.image[:, :15], np.broadcast_to(BACKGROUND, (5, 15, 3)))
    np.testing.assert_array_equal(view.image[:, 21:], np.broadcast_to(BACKGROUND, (5, 19, 3)))


def test_beyond_the_left_camera_the_right_image_shows_what_the_left_one_lacks():
    left, right, estimate = wall_with_object(slice(20, 26))
    view = render(left, right, estimate, -0.5)
    # The object is at 25..30. The left camera sees the wall up to column 19, which is 20 in the view; the
    # right camera sees it from 16 on, which is 19 in the view, up to the object. So there is no hole.
    np.testing.assert_array_equal(view.image[:, 25:31], np.broadcast_to(OBJECT, (5, 6, 3)))
    np.testing.assert_array_equal(view.image[:, 31:], np.broadcast_to(BACKGROUND, (5, 9, 3)))
    assert view.drawn[:, 1:].all()
    # The first column of the left image is at 1, that of the right image at 3.
    assert not view.drawn[:, 0].any()


def test_holes_are_exactly_the_pixels_that_neither_camera_sees():
    # The object is at 25..40. The left camera sees the wall up to column 19, which is 20 in the view; the
    # right camera sees it up to 9, and from 26 on, which is 29 in the view and behind the object.
    left, right, estimate = wall_with_object(slice(20, 36))
    shade = np.arange(40, dtype=np.uint8)[None, :, None]
    left = np.where(left == BACKGROUND, left + shade, left)
    right = np.where(right == BACKGROUND, right + shade + 2, right)
    view = render(left, right, estimate, -0.5)
    hole = np.zeros(40, bool)
    hole[0] = True  # left of the left image
    hole[20:25] = True  # includes 20, which the left camera saw at the object's rim, where colours mix
    np.testing.assert_array_equal(~view.drawn, np.tile(hole, (5, 1)))
    np.testing.assert_array_equal(view.image[:, 25:40], np.broadcast_to(OBJECT, (5, 15, 3)))
    # The wall continues in its own shades, not in the object's colour.
    shades = view.image[:, 20:25].astype(int) - BACKGROUND
    np.testing.assert_array_equal(shades, np.broadcast_to(shades[..., :1], shades.shape))
    assert set(shades.ravel()) <= set(range(2, 19))


def test_a_seam_of_mixed_colours_around_an_object_stays_with_the_object():
    left, right, estimate = wall_with_object(slice(20, 26))
    mixed = (OBJECT // 2 + BACKGROUND // 2).astype(np.uint8)
    left[:, [19, 26]] = mixed
    right[:, [9, 16]] = mixed
    view = render(left, right, estimate, 0.5)
    wall = np.r_[0:14, 22:40]
    apart = np.abs(view.image[:, wall].astype(int) - BACKGROUND)
    # Each image's seam falls on wall that the other image shows clean, and has a tenth of the weight: 9 % of
    # 105.
    assert apart.max() <= 10


@pytest.mark.parametrize(("confidence", "level"), [(0.05, 156), (0.95, 167)])
def test_confidence_decides_between_maps_that_contradict_each_other(confidence, level):
    # The left map has an object at 24..29 of the new view, which the right map contradicts; the images differ
    # equally everywhere. Only the left camera sees the object, which halves its weight; both see the wall.
    left, right = np.full((9, 60, 3), 200, np.uint8), np.full((9, 60, 3), 100, np.uint8)
    disparity_px = np.full((9, 60), 2.0)
    disparity_px[:, 30:36] = 12
    certainty = np.where(disparity_px > 2, confidence, 0.9)
    view = render(left, right, make_estimate(disparity_px, np.full((9, 60), 2.0), certainty), 0.5)
    of_object, of_wall = 0.5 * (0.3 + confidence), 0.3 + 0.9
    assert level == round(150 + 50 * of_object / (of_object + of_wall))
    assert (view.image[:, 24:28] == level).all()


def test_a_thin_object_that_both_maps_missed_is_not_doubled():
    # A stick before a shaded wall, at 20 in the left image and at 12 in the right one. The maps have only the
    # wall, at 2, so the halfway view would show the stick twice, at 19 and at 13.
    wall = np.repeat((100 + np.arange(40) // 4)[None, :, None], 9, axis=0).repeat(3, axis=2).astype(np.uint8)
    left, right = wall.copy(), np.roll(wall, -2, axis=1)
    left[:, 20], right[:, 12] = OBJECT, OBJECT
    flat_px = np.full((9, 40), 2.0)
    view = render(left, right, make_estimate(flat_px, flat_px), 0.5)
    expected = np.roll(wall, -1, axis=1)
    assert np.abs(view.image.astype(int) - expected)[:, 3:-3].max() <= 2


def test_a_row_that_nothing_lands_on_shows_the_nearest_image_marked_as_filled():
    left, right = np.full((2, 6, 32, 3), 50, np.uint8)
    view = render(left + 10, right, make_estimate(*np.full((2, 6, 32), 500.0)), 0.4)
    assert (view.image == 60).all()
    assert not view.drawn.any()


def test_images_and_estimate_may_be_read_only_and_are_not_changed(rng):
    left, right, estimate = random_scene(rng)
    before = left.copy(), estimate.disparity_px.copy()
    expected = render(left, right, estimate, 0.3)
    for array in (left, right, estimate.disparity_px, estimate.confidence):
        array.flags.writeable = False
    flipped = left[:, ::-1].copy()[:, ::-1]  # the same, not contiguous
    np.testing.assert_array_equal(render(flipped, right, estimate, 0.3).image, expected.image)
    np.testing.assert_array_equal(left, before[0])
    np.testing.assert_array_equal(estimate.disparity_px, before[1])


@pytest.mark.parametrize("position", [-1.01, 2.01, float("nan"), float("inf")])
def test_a_position_out_of_range_is_refused(rng, position):
    with pytest.raises(ValueError, match=rf"^position: expected -1 to 2 .*, got {position:g}$"):
        render(*random_scene(rng), position)


@pytest.mark.usefixtures("without_shape_checks")
def test_sizes_that_differ_are_refused_in_one_line(rng):
    left, right, estimate = random_scene(rng)
    with pytest.raises(ValueError, match=r"^left and right images must have the same size.*$"):
        render(left[:, 1:], right, estimate, 0.5)
    with pytest.raises(ValueError, match=r"^estimate: expected the size of the images, 39x14, got 40x14; "):
        render(left[:, 1:], right[:, 1:], estimate, 0.5)


def test_an_estimate_of_an_aligned_pair_fits_no_other_pair(rng):
    left, right, estimate = random_scene(rng)
    aligned = replace(estimate, pair=StereoPair(left=left, right=right))
    swapped = StereoPair(left=right, right=left)
    with pytest.raises(
        ValueError, match=r"^pair: expected the images that .+, found others; use estimate\.pair"
    ):
        Renderer(swapped, aligned)
    same = StereoPair(left=left.copy(), right=right.copy())
    np.testing.assert_array_equal(
        Renderer(same, aligned).view(0.5).image, render(left, right, estimate, 0.5).image
    )


@pytest.mark.parametrize("convergence_px", [0, 2, 10])
@pytest.mark.parametrize("position", [0.0, 0.5, 1.0])
def test_convergence_keeps_its_plane_in_place(convergence_px, position):
    # The object, of disparity 10, is at 20 in the left image and at 10 in the right one.
    left, right, estimate = wall_with_object(slice(20, 26))
    renderer = Renderer(StereoPair(left=left, right=right), estimate, convergence_px=convergence_px)
    first = {0: 20 - 10 * position, 10: 15, 2: 20 - 10 * position + 2 * (position - 0.5)}[convergence_px]
    is_object = (renderer.view(position).image[2] == OBJECT).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(is_object)[[0, -1]], [np.ceil(first), np.floor(first + 5)])


@pytest.mark.parametrize(
    ("position", "up", "columns", "rows"),
    [
        (0.0, 0.0, slice(6, 40), slice(0, 12)),
        (1.0, 0.0, slice(0, 30), slice(0, 12)),
        # The wall has disparity 4: the left image moves by 2 px to the left, the right one to the right.
        (0.5, 0.0, slice(4, 32), slice(0, 12)),
        (0.5, 0.5, slice(4, 32), slice(2, 12)),
    ],
)
def test_what_lies_outside_an_image_s_content_is_not_drawn(position, up, columns, rows):
    left_seen, right_seen = np.ones((2, 12, 40), bool)
    left_seen[:, :6] = right_seen[:, 30:] = False
    image = np.tile(BACKGROUND, (12, 40, 1))
    pair = StereoPair(left=image, right=image, left_seen=left_seen, right_seen=right_seen)
    view = Renderer(pair, make_estimate(*np.full((2, 12, 40), 4.0))).view(position, up=up)
    expected = np.zeros((12, 40), bool)
    expected[rows, columns] = True
    np.testing.assert_array_equal(view.drawn, expected)


def test_strength_widens_the_baseline_about_the_middle(rng):
    left, right, estimate = random_scene(rng)
    pair = StereoPair(left=left, right=right)
    wide = Renderer(pair, estimate, strength=1.6).view(0.75)
    np.testing.assert_array_equal(wide.image, render(left, right, estimate, 0.5 + 1.6 * 0.25).image)
    with pytest.raises(
        ValueError, match=r"^strength: expected views from -1 to 2 .+ got 2\.1 \(.* at strength 1\.6\)$"
    ):
        Renderer(pair, estimate, strength=1.6).view(1.5)


@pytest.mark.parametrize("shift", [-2.0, -0.5, 0.0, 0.25, 1.0, 1.5])
@pytest.mark.parametrize("lowest_px", [0.0, -8.0])
@pytest.mark.parametrize("offset_px", [0.0, -2.3])
def test_the_fast_splat_equals_the_plain_one(rng, shift, lowest_px, offset_px):
    disparity_px = random_scene(rng, lowest_px=lowest_px)[2].disparity_px
    landed_px = np.empty_like(disparity_px)
    splat(disparity_px, shift, offset_px, landed_px)
    expected = plain_splat(disparity_px.astype(float), shift, offset_px)
    np.testing.assert_array_equal(landed_px == NOTHING, np.isnan(expected))
    np.testing.assert_allclose(landed_px[landed_px > NOTHING], expected[~np.isnan(expected)], atol=1e-4)


@pytest.mark.parametrize("position", [-1.0, -0.2, 0.25, 0.5, 0.9, 2.0])
@pytest.mark.parametrize("lowest_px", [0.0, -8.0])
@pytest.mark.parametrize("convergence_px", [0.0, 3.3])
def test_the_fast_renderer_equals_the_plain_one(rng, position, lowest_px, convergence_px):
    for _ in range(2):
        left, right, estimate = random_scene(rng, lowest_px=lowest_px)
        pair = StereoPair(left=left, right=right)
        view = Renderer(pair, estimate, convergence_px=convergence_px).view(position)
        image, drawn, pure = plain_rendering(left, right, estimate, position, convergence_px)
        compared = pure | (0 <= position <= 1)
        np.testing.assert_array_equal(view.drawn[compared], drawn[compared])
        # The renderer computes in float32: a colour at a steep edge of noise may round to the next level.
        assert np.abs(view.image.astype(int) - image)[compared].max() <= 1


def in_new_process(code, home, **variables):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), **UNMEASURED, **variables}
    return subprocess.run(
        [sys.executable, "-B", "-c", code],
        env=environment,
        cwd=home,
        capture_output=True,
        text=True,
        check=True,
    ).stdout


SPLAT = """
import sys
sys.path.insert(0, {folder!r})
import numpy as np
from stereoweave.rendering import canvas_kernels as kernels
assert kernels.__file__.startswith({folder!r})
kernels.splat(np.zeros((2, 3), np.float32), 0.5, 0.0, np.zeros((2, 3), np.float32))
print(kernels.splat.loads)
"""


@pytest.fixture
def installation(tmp_path):
    """Copy the package to where an installation might be. Returns the folder."""
    folder = tmp_path / "site-packages"
    package = Path(stereoweave.__file__).parent
    shutil.copytree(package, folder / "stereoweave", ignore=shutil.ignore_patterns("weights", "__pycache__"))
    return folder


def test_compiled_kernels_are_stored_in_the_user_s_folder_and_loaded_from_it(installation, tmp_path):
    code = SPLAT.format(folder=str(installation))
    before = sorted(installation.rglob("*"))
    assert in_new_process(code, tmp_path) == "0\n"
    assert in_new_process(code, tmp_path) == "1\n"
    assert sorted(installation.rglob("*")) == before
    assert list((tmp_path / "cache" / "stereoweave" / "kernels").rglob("canvas_kernels.splat*.nbi"))


def test_numbas_own_variable_moves_the_kernels(installation, tmp_path):
    in_new_process(
        SPLAT.format(folder=str(installation)), tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "elsewhere")
    )
    assert list((tmp_path / "elsewhere").rglob("canvas_kernels.splat*.nbi"))
    assert not (tmp_path / "cache").exists()


def test_without_any_writable_folder_the_kernels_still_work(installation, tmp_path):
    # Nobody, not even the superuser, can make a folder below a file.
    (tmp_path / "cache").write_text("")
    (installation / "stereoweave" / "__pycache__").write_text("")
    code = SPLAT.format(folder=str(installation))
    assert in_new_process(code, tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache")) == "0\n"


def test_without_a_home_folder_the_kernels_still_work(installation, tmp_path):
    code = SPLAT.format(folder=str(installation))
    assert in_new_process(code, tmp_path, XDG_CACHE_HOME="~nobody-of-this-name/cache") == "0\n"


@pytest.mark.parametrize("position", [0.5, 1.5])
def test_the_view_does_not_depend_on_the_number_of_threads(rng, position):
    # For views from beyond the cameras, hidden background is found in bands of 60 rows.
    scene = random_scene(rng, height=130)
    one, three = (render(*scene, position, threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(three.image, one.image)
    np.testing.assert_array_equal(three.drawn, one.drawn)


def test_importing_the_package_or_the_renderer_does_not_import_numba():
    code = "import sys, stereoweave, stereoweave.rendering.renderer; print('numba' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "False\n"
    )


def test_between_images_of_different_exposure_the_look_changes_gradually(rng):
    coarse = rng.integers(20, 200, (12, 16, 3)).astype(np.uint8)
    left = np.repeat(np.repeat(coarse, 8, axis=0), 8, axis=1)
    brighter = np.rint(left * 1.2).astype(np.uint8)
    flat_px = np.zeros(left.shape[:2], np.float32)
    seen = replace(make_estimate(flat_px, flat_px), occluded=np.zeros(flat_px.shape, bool))
    for position in (0.25, 0.5, 0.75):
        view = render(left, brighter, seen, position)
        expected = left * (1 + 0.2 * position)
        assert np.abs(view.image - expected).mean() < 1


@pytest.mark.parametrize("convergence_px", [float("nan"), float("inf"), -41.0])
def test_a_convergence_beyond_the_pictures_width_is_refused(rng, convergence_px):
    left, right, estimate = random_scene(rng)
    with pytest.raises(
        ValueError, match=r"^convergence_px: expected -40 to 40 px \(the picture's width\), got "
    ):
        Renderer(StereoPair(left=left, right=right), estimate, convergence_px=convergence_px)


@pytest.mark.parametrize("strength", [float("nan"), float("inf"), -1.0])
def test_an_invalid_strength_is_refused(rng, strength):
    left, right, estimate = random_scene(rng)
    with pytest.raises(ValueError, match=r"^strength: expected 0 or more, got "):
        Renderer(StereoPair(left=left, right=right), estimate, strength=strength)


def test_a_view_from_above_also_moves_surfaces_of_negative_disparity():
    # The wall at -8 px is taken to be infinitely far; the stripe at -3 px is 5 px nearer.
    left = np.zeros((20, 30, 3), np.uint8)
    left[8:12] = 200
    disparity_px = np.full((20, 30), -8.0)
    disparity_px[8:12] = -3
    renderer = Renderer(StereoPair(left=left, right=left), make_estimate(disparity_px, disparity_px))
    level, above = (renderer.view(0.0, up=up).image[:, 15, 0] for up in (1e-9, 1.0))
    np.testing.assert_array_equal(np.flatnonzero(level > 100), np.arange(8, 12))
    np.testing.assert_array_equal(np.flatnonzero(above > 100), np.arange(13, 17))


def test_a_renderer_is_shown_by_its_size_and_settings():
    left, right, estimate = wall_with_object(slice(20, 30))
    renderer = Renderer(StereoPair(left=left, right=right), estimate, strength=1.5, convergence_px=2)
    assert repr(renderer) == "Renderer(40x5, strength 1.5, convergence 2 px)"
