"""Layouts match values computed by hand and the views that they consist of."""

import io
from pathlib import Path

import numpy as np
import pytest
from full_disks import disk_with_room
from PIL import Image

from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_image
from stereoweave.rendering.layouts import (
    ANIMATIONS,
    LAYOUTS,
    LayoutOptions,
    add_mark,
    check_positions,
    choose_layout,
    median_disparity_px,
    render_views,
    write_picture,
)
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair

PAIR_LAYOUTS = ["side_by_side", "side_by_side_half", "crossed", "top_bottom", "top_bottom_half"]
ANAGLYPHS = ["anaglyph_grey", "anaglyph_colour", "anaglyph_half_colour", "anaglyph_dubois"]


def estimate_of(disparity_px: np.ndarray, confidence: np.ndarray | None = None) -> Estimate:
    disparity_px = disparity_px.astype(np.float32)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=(np.ones_like(disparity_px) if confidence is None else confidence).astype(np.float32),
        occluded=np.zeros(disparity_px.shape, bool),
    )


def renderer_of(left: np.ndarray, right: np.ndarray, disparity_px: float = 0.0) -> Renderer:
    estimate = estimate_of(np.full(left.shape[:2], disparity_px))
    return Renderer(StereoPair(left=left, right=right), estimate, threads=1)


def composed(name: str, renderer: Renderer, **choices) -> np.ndarray:
    return LAYOUTS[name].compose(renderer, LayoutOptions(**choices))


def plain(*colour: int, height: int = 2, width: int = 2) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


@pytest.fixture
def wall(rng) -> Renderer:
    """Return a renderer of a wall at disparity 4 with a pattern of 3 px, in images of 48x33 px."""
    wide = np.asarray(
        Image.fromarray(rng.integers(0, 256, (11, 18, 3), dtype=np.uint8)).resize((54, 33), Image.BICUBIC)
    )
    return renderer_of(wide[:, :48].copy(), wide[:, 4:52].copy(), 4.0)


def test_the_left_eye_is_on_the_left_on_the_right_if_crossed_or_on_top():
    renderer = renderer_of(plain(1, 2, 3), plain(7, 8, 9))
    assert composed("side_by_side", renderer)[0].tolist() == [[1, 2, 3]] * 2 + [[7, 8, 9]] * 2
    assert composed("crossed", renderer)[0].tolist() == [[7, 8, 9]] * 2 + [[1, 2, 3]] * 2
    assert composed("top_bottom", renderer)[:, 0].tolist() == [[1, 2, 3]] * 2 + [[7, 8, 9]] * 2


def test_half_width_averages_two_columns_and_keeps_the_last_of_an_odd_width():
    row = np.repeat(np.array([[10, 20, 30, 50, 90]], np.uint8)[..., None], 3, axis=2)
    picture = composed("side_by_side_half", renderer_of(row, row + 100))
    assert picture[..., 1].tolist() == [[15, 40, 90, 115, 140, 190]]


def test_half_height_averages_two_rows_and_keeps_the_last_of_an_odd_height():
    column = np.repeat(np.array([[10], [20], [60]], np.uint8)[..., None], 3, axis=2)
    picture = composed("top_bottom_half", renderer_of(column, column + 100))
    assert picture[..., 1].tolist() == [[15], [60], [115], [160]]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # 0.299 * 100 + 0.587 * 50 + 0.114 * 200 = 82.05; 0.299 * 40 + 0.587 * 120 + 0.114 * 80 = 91.52
        ("anaglyph_grey", [82, 92, 92]),
        ("anaglyph_colour", [100, 120, 80]),
        ("anaglyph_half_colour", [82, 120, 80]),
        # 105.91 - 12.42; -9.05 + 101.70; -3.65 + 81.67
        ("anaglyph_dubois", [93, 93, 78]),
    ],
)
def test_red_shows_the_left_eye_s_view_and_cyan_the_right_one_s(name, expected):
    picture = composed(name, renderer_of(plain(100, 50, 200), plain(40, 120, 80)))
    assert picture[0, 0].tolist() == expected


@pytest.mark.parametrize("name", ANAGLYPHS)
@pytest.mark.parametrize("level", [0, 100, 255])
def test_a_grey_that_both_eyes_see_is_unchanged(name, level):
    grey = plain(level, level, level)
    np.testing.assert_array_equal(composed(name, renderer_of(grey, grey)), grey)


def test_colours_that_an_anaglyph_cannot_show_are_clipped():
    # With Dubois's matrices, this pair's green is -0.04 * 255 and its red 0.456 * 255.
    picture = composed("anaglyph_dubois", renderer_of(plain(255, 0, 0), plain(0, 0, 0)))
    assert picture[0, 0].tolist() == [116, 0, 0]


def test_near_disparity_is_white_and_clipped_beyond_the_range():
    left = plain(1, 2, 3, height=1, width=4)
    pair = StereoPair(left=left, right=plain(7, 8, 9, height=1, width=4))
    renderer = Renderer(pair, estimate_of(np.array([[-3.0, 2.0, 10.0, 20.0]])), threads=1)
    picture = composed("rgbd", renderer, range_px=(0.0, 10.0))
    np.testing.assert_array_equal(picture[:, :4], left)
    assert picture[0, 4:].tolist() == [[0] * 3, [51] * 3, [255] * 3, [255] * 3]


def test_rgbd_uses_the_range_of_its_own_disparities_unless_given_one(rng):
    disparity_px = np.linspace(5.0, 25.0, 1000).reshape(20, 50)
    pair = StereoPair(left=plain(1, 2, 3, height=20, width=50), right=plain(7, 8, 9, height=20, width=50))
    depth = composed("rgbd", Renderer(pair, estimate_of(disparity_px), threads=1))[:, 50:]
    assert (depth.min(), depth.max()) == (0, 255)
    assert depth[10, 0, 0] == 128


def test_a_quilt_runs_from_the_bottom_left_to_the_top_right(wall):
    picture = composed("quilt", wall, columns=3, rows=2)
    # Six views, from -0.5 to 1.5, are 0.4 apart.
    expected = [(0.7, 1.1, 1.5), (-0.5, -0.1, 0.3)]
    rows = [np.hstack([wall.view(position).image for position in row]) for row in expected]
    np.testing.assert_array_equal(picture, np.vstack(rows))


def test_in_a_quilt_the_wall_moves_left_as_the_camera_moves_right(wall):
    tiles = np.split(composed("quilt", wall, columns=3, rows=1), 3, axis=1)
    # The three cameras are one baseline apart, and so 4 px.
    np.testing.assert_allclose(tiles[0][:, 8:40].astype(int), tiles[1][:, 4:36].astype(int), atol=24)
    np.testing.assert_allclose(tiles[1][:, 8:40].astype(int), tiles[2][:, 4:36].astype(int), atol=24)


def test_a_quilt_is_scaled_down_to_at_most_8192_px():
    renderer = renderer_of(*np.zeros((2, 20, 200, 3), np.uint8))
    # 50 * 200 px are 1.2207 times 8192 px, so views have 163x16 px.
    assert composed("quilt", renderer, columns=50, rows=4).shape == (4 * 16, 50 * 163, 3)


@pytest.mark.parametrize(("columns", "rows"), [(0, 6), (1, 1), (-2, -3), (21, 10)])
def test_a_quilt_has_2_to_200_views(columns, rows):
    with pytest.raises(StereoweaveError, match=f"2 to 200 views, got {columns}x{rows}"):
        LayoutOptions(columns=columns, rows=rows)


def test_a_contact_sheet_runs_from_the_left_camera_to_the_right_one(wall):
    sheet = composed("contact_sheet", wall)
    assert sheet.shape == (33, 48, 3)
    left, middle, right = (
        np.asarray(Image.fromarray(wall.view(position).image).resize((16, 11), Image.BOX)).astype(int)
        for position in (-0.5, 0.5, 1.5)
    )
    np.testing.assert_allclose(sheet[:11, :16], left, atol=1)
    np.testing.assert_allclose(sheet[11:22, 16:32], middle, atol=1)
    np.testing.assert_allclose(sheet[22:, 32:], right, atol=1)


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_accepts_odd_sizes_and_leaves_the_pair_unchanged(name, rng):
    left, right = rng.integers(0, 256, (2, 33, 45, 3), dtype=np.uint8)
    before = left.copy(), right.copy()
    picture = composed(name, renderer_of(left, right, 2.0))
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3
    np.testing.assert_array_equal((left, right), before)


def test_an_animation_moves_back_and_forth_without_a_repeated_frame():
    for motion in ANIMATIONS.values():
        positions = np.array(motion.positions)
        assert positions[0] == 0
        assert positions.max() <= 1
        np.testing.assert_allclose(positions[1:], positions[:0:-1], atol=1e-12)
        assert (np.diff(np.append(positions, positions[0])) != 0).all()
        assert motion.frame_ms % 10 == 0


def test_a_wiggle_reaches_both_cameras():
    assert {0.0, 1.0} <= set(ANIMATIONS["wiggle"].positions)


def test_an_mp4_repeats_the_wiggle_and_looping_formats_do_not():
    wiggle = ANIMATIONS["wiggle"]
    assert (wiggle.turns("a.gif"), wiggle.turns("a.webp")) == (1, 1)
    assert 3000 < wiggle.turns("a.MP4") * len(wiggle.positions) * wiggle.frame_ms < 5000


def test_frames_are_rendered_on_demand(wall):
    coming = render_views(wall, [1.0, 7.0])
    np.testing.assert_array_equal(next(coming), wall.pair.right)
    with pytest.raises(StereoweaveError, match="position"):
        next(coming)


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("quilt", "view.png", "view_qs8x6a0.75.png"),
        ("quilt", "a.b/view.v2.jpg", "a.b/view.v2_qs8x6a0.75.jpg"),
        ("quilt", "view_qs8x6a0.75.png", "view_qs8x6a0.75.png"),
        ("side_by_side", "view.png", "view_LRF_Full_SBS.png"),
        ("side_by_side", "view.MPO", "view.MPO"),
        ("side_by_side_half", "view.png", "view_half_LR.png"),
        ("crossed", "view.png", "view_RLF_cross.png"),
        ("crossed", "view.jps", "view.jps"),
        ("top_bottom", "view.png", "view_TBF_fulltb.png"),
        ("top_bottom_half", "view.png", "view_half_TB.png"),
        ("rgbd", "view.png", "view_RGBD.png"),
        ("anaglyph_dubois", "view.png", "view.png"),
        ("contact_sheet", "view.png", "view.png"),
    ],
)
def test_a_file_name_has_the_suffix_that_viewers_look_for(name, given, expected):
    picture = plain(0, 0, 0, height=8, width=6)
    assert add_mark(given, name, StereoPair(left=picture, right=picture), LayoutOptions()) == Path(expected)


def test_the_suffix_of_a_quilt_gives_its_grid_and_aspect_ratio():
    picture = plain(0, 0, 0, height=9, width=16)
    pair = StereoPair(left=picture, right=picture)
    assert add_mark("view.png", "quilt", pair, LayoutOptions(columns=5, rows=9)) == Path(
        "view_qs5x9a1.778.png"
    )


@pytest.mark.parametrize(
    ("path", "name", "expected"),
    [
        ("view.png", None, None),
        ("view.mpo", None, "side_by_side"),
        ("view.JPS", None, "crossed"),
        ("view.mpo", "side_by_side", "side_by_side"),
        ("view.webp", "quilt", "quilt"),
        ("view.webp", "wiggle", "wiggle"),
    ],
)
def test_a_layout_is_chosen_by_name_or_by_the_file_s_ending(path, name, expected):
    assert choose_layout(path, name) == expected


@pytest.mark.parametrize(
    ("path", "name", "expected"),
    [
        ("view.png", "quild", "side_by_side, .*, quilt, .*, wiggle, viewer, found 'quild'"),
        ("view.mpo", "crossed", r"view\.mpo: expected the layout side_by_side .* found crossed"),
        ("view.jps", "quilt", r"view\.jps: expected the layout crossed .* found quilt"),
        ("view.png", "wiggle", r"view\.png: expected an animation file extension \(\.mp4, \.gif, \.webp"),
        ("view.gif", "quilt", r"view\.gif: expected a picture file extension \(\.png"),
        ("view.png", "viewer", r"view\.png: expected the file extension \.html for the layout viewer"),
        ("view.html", "quilt", r"view\.html: expected the layout viewer .* found quilt"),
        ("view.mp4", None, r"view\.mp4: expected an animation .* choose sweep or wiggle \(layout\)$"),
        (
            "view.txt",
            None,
            r"found \.txt; 3-D pictures have \.mpo, .*, \.html; sweep and wiggle \.mp4, \.gif$",
        ),
        ("view.txt", "quilt", r"view\.txt: expected a picture file extension \(\.png.*, found \.txt$"),
    ],
)
def test_an_unknown_layout_or_one_that_does_not_fit_the_ending_is_refused(path, name, expected):
    with pytest.raises(StereoweaveError, match=expected):
        choose_layout(path, name)


@pytest.mark.parametrize(
    ("positions", "strength"),
    [((-1.0, 2.0), 1.0), ((0.0, 1.0), 3.0), ((-0.5, 1.5), 1.5), ((2.5,), 0.5), ((), 100.0)],
)
def test_positions_that_can_be_rendered_are_accepted(positions, strength):
    check_positions(positions, strength)


@pytest.mark.parametrize(
    ("positions", "strength", "found"),
    [
        ((7.0,), 1.0, "position: expected -1 to 2 .*, got 7"),
        ((5.0,), 0.5, "position: expected -1 to 2 .*, got 5"),
        ((float("nan"),), 1.0, "position: expected -1 to 2 .*, got nan"),
        ((0.0, 1.0), 4.0, r"strength: expected views from -1 to 2 .*, got -1.5 \(position 0 at .*\)"),
        (
            (0.5, 1.5),
            2.0,
            r"strength: expected views from -1 to 2 .*, got 2.5 \(position 1.5 at .*\)",
        ),
        ((0.5,), float("nan"), "strength: expected views from -1 to 2 .*, got nan"),
    ],
)
def test_positions_that_cannot_be_rendered_are_refused(positions, strength, found):
    with pytest.raises(StereoweaveError, match=f"^{found}"):
        check_positions(positions, strength)


def test_the_median_disparity_is_weighted_by_confidence():
    disparity_px, confidence = np.array([[1.0, 100, 6, 7, 5]]), np.array([[1.0, 0.1, 0.1, 0.1, 1]])
    # In order 1, 5, 6, 7, 100 px: half of the sum, 1.15, is reached at 5 px.
    assert median_disparity_px(estimate_of(disparity_px, confidence)) == 5
    assert median_disparity_px(estimate_of(disparity_px, np.zeros((1, 5)))) == 6


def test_an_mpo_file_holds_two_pictures_the_left_eye_s_first(tmp_path, wall):
    write_picture(tmp_path / "view.mpo", composed("side_by_side", wall))
    with Image.open(tmp_path / "view.mpo") as file:
        assert (file.format, file.n_frames) == ("MPO", 2)
        for index, eye in enumerate((wall.pair.left, wall.pair.right)):
            file.seek(index)
            assert (
                np.abs(np.asarray(file.convert("RGB")).astype(int) - eye).mean() < 4
            )  # the other eye's view differs by 50
    assert [file.name for file in tmp_path.iterdir()] == ["view.mpo"]


def test_a_jps_file_is_a_jpeg_whose_header_gives_the_layout(tmp_path, wall):
    picture = composed("crossed", wall)
    write_picture(tmp_path / "view.jps", picture)
    with Image.open(io.BytesIO((tmp_path / "view.jps").read_bytes())) as file:
        segments = dict(file.applist)
        assert file.format == "JPEG"
        assert np.abs(np.asarray(file).astype(int) - picture).mean() < 4
    # By ExifTool's table: flags without "left field first", layout 2 side by side, type 1 stereo.
    assert segments["APP3"][:8] == b"_JPSJPS_"
    assert list(segments["APP3"][10:14]) == [0, 0, 2, 1]


@pytest.mark.parametrize(("ending", "layout"), [(".mpo", "side_by_side"), (".jps", "crossed")])
def test_a_stereo_picture_that_a_full_disk_cuts_off_is_an_error(tmp_path, wall, ending, layout):
    path, picture = tmp_path / f"view{ending}", composed(layout, wall)
    write_picture(path, picture)
    with (
        disk_with_room(path.stat().st_size - 1),
        pytest.raises(StereoweaveError, match=f"^{path}: expected a writable file, found file too large$"),
    ):
        write_picture(path, picture)
    with Image.open(path) as file:
        file.seek(file.n_frames - 1 if ending == ".mpo" else 0)
        file.load()


def test_other_endings_are_ordinary_pictures(tmp_path, wall):
    picture = composed("quilt", wall)
    write_picture(tmp_path / "view.png", picture)
    np.testing.assert_array_equal(read_image(tmp_path / "view.png"), picture)
