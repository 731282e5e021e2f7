import io
import re
import struct
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from picture_examples import DISPLAY_P3, SRGB, png_of, profile
from PIL import Image, ImageCms
from skimage import data
from video_examples import packed, shrunk

from stereoweave.cli.options import Format
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.exif import Lens
from stereoweave.io.images import read_image, write_image
from stereoweave.pictures.anaglyphs import looks_like_anaglyph
from stereoweave.pictures.interleaved import INTERLEAVED_LAYOUTS
from stereoweave.pictures.loading import FORMATS, open_pictures, pixel_factor
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions, add_mark, write_picture
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
ORIENTATION, EXIF, FOCAL_35_MM, MODEL = 0x0112, 0x8769, 0xA405, 0x0110
FOCAL_MM, WIDTH_PX, PLANE_X, PLANE_UNIT = 0x920A, 0xA002, 0xA20E, 0xA210
FINE = {"quality": 97, "subsampling": 0}


@pytest.fixture(scope="module")
def pair():
    left, right = (shrunk(read_image(TEXTURED / f"{eye}.png"), 240, 160) for eye in ("left", "right"))
    return StereoPair(left=left, right=right)


def assert_eyes(opened, pair, tolerance=0.0):
    """Require both views to equal the pair's images, up to a mean difference of `tolerance` levels."""
    for found, taken in ((opened.pair.left, pair.left), (opened.pair.right, pair.right)):
        assert found.shape == taken.shape
        assert np.abs(found.astype(int) - taken).mean() <= tolerance


def refusal(*paths, format=None, kind=FormatError):
    with pytest.raises(kind) as caught:
        open_pictures(list(paths), format)
    message = str(caught.value)
    assert "\n" not in message
    return message


def tagged(lies=None, focal_35_mm=None, model=None):
    tags = Image.Exif()
    if lies:
        tags[ORIENTATION] = lies
    if model:
        tags[MODEL] = model
    if focal_35_mm:
        tags.get_ifd(EXIF)[FOCAL_35_MM] = focal_35_mm
    return tags


def write_two(folder, left, right, left_exif=None, right_exif=None):
    paths = folder / "left.png", folder / "right.png"
    for path, image, tags in zip(paths, (left, right), (left_exif, right_exif), strict=True):
        Image.fromarray(image).save(path, exif=tags or Image.Exif())
    return paths


def write_mpo(path, left, right, **options):
    first, second = Image.fromarray(left), Image.fromarray(right)
    first.save(path, "MPO", save_all=True, append_images=[second], **FINE, **options)
    return path


def write_jps(path, image, flags, layout=2, kind=1):
    # JPEG's marker APP3 and its length; the name; the number of bytes, four: separation, flags, layout, type.
    segment = b"\xff\xe3\x00\x12_JPSJPS_\x00\x04" + bytes([0, flags, layout, kind]) + b"\0\0"
    Image.fromarray(image).save(path, "JPEG", extra=segment, **FINE)
    return path


# Two files


def test_two_files_are_the_left_and_the_right_view(tmp_path, pair):
    opened = open_pictures(write_two(tmp_path, pair.left, pair.right))
    assert_eyes(opened, pair)
    assert (opened.layout, opened.notes, opened.lens) == ("two_pictures", (), None)
    assert opened.pair.left.flags.writeable


def test_two_files_of_different_sizes_are_refused_with_both_sizes(tmp_path, pair):
    left, right = write_two(tmp_path, pair.left, pair.right[:, 2:])
    message = refusal(left, right)
    assert f"{left} with 240x160 and {right} with 238x160" in message


def test_two_files_of_under_32_pixels_are_refused(tmp_path, pair):
    left, right = write_two(tmp_path, pair.left[:31], pair.right[:31])
    assert f"{left}: expected at least 32x32 pixels, found 240x31" in refusal(left, right)


def test_the_damaged_one_of_two_files_is_named(tmp_path, pair):
    left, right = write_two(tmp_path, pair.left, pair.right)
    right.write_bytes(right.read_bytes()[:3000])
    assert refusal(left, right).startswith(f"{right}: expected a picture")
    left.unlink()
    assert (
        refusal(left, right)
        == f"{left}: expected a picture (PNG, JPEG, TIFF or the like), found no such file"
    )


@pytest.mark.parametrize("alone", [True, False])
def test_values_that_no_photograph_has_are_refused_with_the_name(tmp_path, pair, alone):
    left, right = write_two(tmp_path, pair.left, pair.right)
    left = left.with_suffix(".tif")
    Image.fromarray(pair.left[..., 0].astype(np.float32)).save(left)
    message = refusal(left) if alone else refusal(left, right)
    assert message.startswith(f"{left}: expected a picture")
    assert "more than 16 bits per channel" in message


@pytest.mark.parametrize("count", [0, 3])
def test_one_or_two_files_are_expected(tmp_path, count):
    message = refusal(*[tmp_path / "a.png"] * count, kind=StereoweaveError)
    assert f"one that holds both views, found {count}" in message


def test_a_format_is_for_one_file_and_one_of_the_formats(tmp_path):
    two = [tmp_path / "a.png", tmp_path / "b.png"]
    assert "found two" in refusal(*two, format="crossed", kind=StereoweaveError)
    message = refusal(two[0], format="sideways", kind=StereoweaveError)
    assert message == f"format: expected one of {', '.join(FORMATS)}, found 'sideways'"


def test_the_help_of_format_names_all_of_them():
    words = re.split(", | or ", get_args(Format)[1].help.partition(": ")[2].partition(" (")[0])
    assert sorted(words) == sorted(FORMATS)


# Orientation


@pytest.mark.parametrize("lies", [3, 6, 8])
def test_two_files_are_turned_upright_each_as_its_tag_says(tmp_path, pair, lies):
    quarter_turns = {3: 2, 6: 1, 8: 3}[lies]
    stored = [np.rot90(eye, quarter_turns) for eye in (pair.left, pair.right)]
    opened = open_pictures(write_two(tmp_path, *stored, tagged(lies), tagged(lies)))
    assert_eyes(opened, pair)
    assert list(map(str, opened.notes)) == ["turned upright by its EXIF orientation"]


@pytest.mark.parametrize("lost", ["left", "right"])
@pytest.mark.parametrize("lies", [3, 6])
def test_a_tag_that_one_of_two_files_has_lost_goes_for_both(tmp_path, pair, lost, lies):
    stored = [np.rot90(eye, {3: 2, 6: 1}[lies]) for eye in (pair.left, pair.right)]
    tags = [None if lost == side else tagged(lies) for side in ("left", "right")]
    opened = open_pictures(write_two(tmp_path, *stored, *tags))
    assert_eyes(opened, pair)
    assert list(map(str, opened.notes)) == ["both pictures turned upright by the only EXIF orientation"]


@pytest.mark.parametrize("lies", [3, 6])
def test_a_file_that_was_turned_when_it_lost_its_tag_is_left_as_it_is(tmp_path, pair, lies):
    stored = np.rot90(pair.left, {3: 2, 6: 1}[lies])
    opened = open_pictures(write_two(tmp_path, stored, pair.right, tagged(lies)))
    assert_eyes(opened, pair)
    assert list(map(str, opened.notes)) == [
        "one picture turned upright by its EXIF orientation, the other unchanged"
    ]


def test_cameras_that_lay_differently_are_each_believed(tmp_path, pair):
    opened = open_pictures(
        write_two(tmp_path, np.rot90(pair.left), np.rot90(pair.right, 3), tagged(6), tagged(8))
    )
    assert_eyes(opened, pair)


def test_where_two_tags_would_make_two_sizes_the_left_one_is_believed(tmp_path, pair):
    opened = open_pictures(write_two(tmp_path, pair.left, pair.right, tagged(1), tagged(6)))
    assert_eyes(opened, pair)
    assert "though the right one differs" in opened.notes[0].text


def test_a_side_by_side_picture_is_turned_as_a_whole(tmp_path, pair):
    whole = np.rot90(np.hstack([pair.left, pair.right]), 2)
    Image.fromarray(whole).save(tmp_path / "both.png", exif=tagged(3))
    opened = open_pictures([tmp_path / "both.png"])
    assert_eyes(opened, pair)
    assert "turned upright by its EXIF orientation" in [note.text for note in opened.notes]


def test_the_first_picture_of_an_mpo_file_says_how_both_lie(tmp_path, pair):
    stored = [np.rot90(eye, 2) for eye in (pair.left, pair.right)]
    opened = open_pictures([write_mpo(tmp_path / "a.mpo", *stored, exif=tagged(3).tobytes())])
    assert_eyes(opened, pair, tolerance=3)


@pytest.mark.parametrize("lies", [3, 6])
def test_a_tiff_is_turned_once(tmp_path, pair, lies):
    paths = tmp_path / "left.tif", tmp_path / "right.tif"
    for path, eye in zip(paths, (pair.left, pair.right), strict=True):
        stored = Image.fromarray(np.rot90(eye, {3: 2, 6: 1}[lies]).copy())
        stored.save(path, tiffinfo={ORIENTATION: lies})
    assert_eyes(open_pictures(paths), pair)


# One file: MPO and JPS


@pytest.mark.parametrize("name", ["a.mpo", "a.jpg"])
@pytest.mark.parametrize("format", [None, "mpo"])
def test_an_mpo_file_holds_the_left_picture_and_then_the_right_one(tmp_path, pair, name, format):
    opened = open_pictures([write_mpo(tmp_path / name, pair.left, pair.right)], format)
    assert_eyes(opened, pair, tolerance=3)
    assert opened.layout == "mpo"
    assert list(map(str, opened.notes)) == [
        "mpo, two pictures in one file; override it if it is wrong (format)"
    ]


def with_frame_tags(path, numbers, baseline):
    """An MPO file of two pictures with their viewpoints' numbers, declared as a disparity."""
    whole = [Image.fromarray(eye) for eye in numbers.values()]
    parts = []
    for image, number in zip(whole, numbers, strict=True):
        entries = struct.pack("<HHLL", 0xB101, 4, 1, number)
        own = struct.pack("<H", 2) + entries
        parts.append((image, own))
    frames = []
    for index, (image, own) in enumerate(parts):
        start = 8 if index else 8 + 2 + 2 * 12 + 4 + 32
        values = start + 2 + 2 * 12 + 4
        own += struct.pack("<HHLL", 0xB206, 5, 1, values) + bytes(4) + struct.pack("<LL", *baseline)
        header = b"II\x2a\0" + struct.pack("<L", 8)
        if not index:
            place = 8 + 2 + 2 * 12 + 4
            header += struct.pack("<HHHLLHHLLL", 2, 0xB001, 4, 1, 2, 0xB002, 7, 32, place, start) + bytes(32)
        content = io.BytesIO()
        payload = b"MPF\0" + header + own
        image.save(content, "JPEG", extra=b"\xff\xe2" + struct.pack(">H", len(payload) + 2) + payload, **FINE)
        frames.append(content.getvalue())
    first, second = frames
    origin = first.index(b"MPF\0") + 4
    entry = struct.pack("<LLLHH", 0x020002, len(first), 0, 0, 0)
    entry += struct.pack("<LLLHH", 0x020002, len(second), len(first) - origin, 0, 0)
    place = origin + 8 + 2 + 2 * 12 + 4
    path.write_bytes(first[:place] + entry + first[place + 32 :] + second)
    return path


def test_the_viewpoints_of_an_mpo_file_are_counted_from_the_left(tmp_path, pair):
    path = with_frame_tags(tmp_path / "a.mpo", {2: pair.right, 1: pair.left}, (77, 1000))
    opened = open_pictures([path])
    assert_eyes(opened, pair, tolerance=3)
    assert opened.lens == Lens(baseline_m=0.077)
    path = with_frame_tags(tmp_path / "b.mpo", {1: pair.left, 2: pair.right}, (77, 1000))
    assert_eyes(open_pictures([path]), pair, tolerance=3)


def test_an_mpo_file_whose_second_picture_is_a_preview_is_one_picture(tmp_path, pair):
    both = np.hstack([pair.left, pair.right])
    path = write_mpo(tmp_path / "a.jpg", both, pair.left)
    opened = open_pictures([path])
    assert opened.layout == "side_by_side"
    assert_eyes(opened, pair, tolerance=3)
    assert "found only one" in refusal(path, format="mpo")


def test_the_first_picture_of_an_mpo_file_may_be_asked_for(tmp_path, pair):
    path = write_mpo(tmp_path / "a.mpo", np.hstack([pair.left, pair.right]), np.hstack([pair.right] * 2))
    assert_eyes(open_pictures([path], "side_by_side"), pair, tolerance=3)


def test_an_mpo_file_of_one_picture_is_one_that_may_hold_both_views(tmp_path, pair):
    path = tmp_path / "a.mpo"
    Image.fromarray(np.hstack([pair.left, pair.right])).save(path, "MPO", **FINE)
    assert_eyes(open_pictures([path]), pair, tolerance=3)


def test_a_truncated_mpo_file_is_refused_in_one_line(tmp_path, pair):
    whole = write_mpo(tmp_path / "a.mpo", pair.left, pair.right).read_bytes()
    cut = tmp_path / "cut.mpo"
    for share in (0.02, 0.3, 0.52, 0.55, 0.8, 0.97):
        cut.write_bytes(whole[: int(share * len(whole))])
        assert refusal(cut).startswith(f"{cut}: expected")
    cut.write_bytes(whole[: whole.index(b"\xff\xd8", 2)])
    assert "found that picture 2 is truncated or damaged" in refusal(cut)


def test_two_mpo_files_are_two_pictures(tmp_path, pair):
    paths = [
        write_mpo(tmp_path / f"{side}.mpo", eye, eye[::-1].copy())
        for side, eye in (("left", pair.left), ("right", pair.right))
    ]
    assert_eyes(open_pictures(paths), pair, tolerance=3)


@pytest.mark.parametrize(
    ("flags", "layout", "format"),
    [
        (0, 2, "crossed"),
        (4, 2, "side_by_side"),
        (2, 2, "crossed_half"),
        (6, 2, "side_by_side_half"),
        (4, 3, "top_bottom"),
        (5, 3, "top_bottom_half"),
        (0, 3, "top_bottom_right_first"),
    ],
)
def test_a_jps_file_says_how_it_holds_its_views(tmp_path, pair, flags, layout, format):
    image = packed(pair.left, pair.right, format)
    for name in ("a.jps", "a.jpg"):
        opened = open_pictures([write_jps(tmp_path / name, image, flags, layout)])
        assert opened.layout == format
        assert list(map(str, opened.notes)) == [
            f"{format}, from its JPS header; override it if it is wrong (format)"
        ]
        assert_eyes(opened, pair, tolerance=12)


def test_what_a_jps_file_says_may_be_overruled(tmp_path, pair):
    path = write_jps(tmp_path / "a.jps", np.hstack([pair.left, pair.right]), flags=0)
    opened = open_pictures([path], "side_by_side")
    assert_eyes(opened, pair, tolerance=3)
    assert opened.notes == ()


def test_a_jps_file_that_says_nothing_is_crossed(tmp_path, pair):
    image = Image.fromarray(np.hstack([pair.right, pair.left]))
    image.save(tmp_path / "a.jps", "JPEG", **FINE)
    opened = open_pictures([tmp_path / "a.jps"])
    assert_eyes(opened, pair, tolerance=3)
    assert list(map(str, opened.notes)) == [
        "crossed, the default of .jps files; override it if it is wrong (format)"
    ]
    image.save(tmp_path / "b.jpg", "JPEG", **FINE)
    assert open_pictures([tmp_path / "b.jpg"], "jps").layout == "crossed"


def test_a_jps_file_that_is_an_anaglyph_is_refused(tmp_path, pair):
    path = write_jps(tmp_path / "a.jps", pair.left, flags=4, layout=4)
    assert "that is an anaglyph; save it side by side" in refusal(path)


@pytest.mark.parametrize(("flags", "layout"), [(4, "row_interleaved"), (0, "row_interleaved_right_first")])
def test_a_jps_file_that_is_interleaved_says_which_view_has_the_first_row(tmp_path, flags, layout):
    grey = {"row_interleaved": (60, 180), "row_interleaved_right_first": (180, 60)}[layout]
    rows = np.where(np.arange(80)[:, None, None] % 2 == 0, *grey).astype(np.uint8)
    path = write_jps(tmp_path / "a.jps", np.tile(rows, (1, 96, 3)), flags, layout=1)
    opened = open_pictures([path])
    assert opened.layout == layout
    assert abs(opened.pair.left.mean() - 60) < 2
    assert abs(opened.pair.right.mean() - 180) < 2


# One file: seen or named


def seen(pair, name, folder):
    write_image(folder / "view.png", packed(pair.left, pair.right, name))
    try:
        return open_pictures([folder / "view.png"]).layout
    except FormatError:
        return "refused"


def windows(width_px, height_px):
    """Nine parts of the example pair."""
    left, right = (read_image(TEXTURED / f"{eye}.png") for eye in ("left", "right"))
    tops, starts = np.linspace(0, 480 - height_px, 3, dtype=int), np.linspace(0, 640 - width_px, 3, dtype=int)
    parts = [np.s_[top : top + height_px, start : start + width_px] for top in tops for start in starts]
    return [StereoPair(left=left[part].copy(), right=right[part].copy()) for part in parts]


@pytest.mark.parametrize("name", ["side_by_side", "side_by_side_half", "top_bottom", "top_bottom_half"])
def test_pairs_are_seen_for_what_they_are_or_refused(tmp_path, name):
    guesses = [seen(pair, name, tmp_path) for pair in windows(320, 240)]
    assert set(guesses) <= {name, "refused"}
    assert guesses.count(name) >= 8


@pytest.mark.parametrize("size_px", [(320, 280), (320, 320), (320, 336), (320, 400)])
def test_half_width_views_of_square_and_upright_pictures_are_seen(tmp_path, size_px):
    guesses = [seen(pair, "side_by_side_half", tmp_path) for pair in windows(*size_px)]
    assert guesses == ["side_by_side_half"] * 9


def test_upright_views_beside_each_other_are_not_taken_for_squeezed_ones(tmp_path):
    for size_px in ((240, 320), (216, 384)):
        guesses = [seen(pair, "side_by_side", tmp_path) for pair in windows(*size_px)]
        assert guesses.count("side_by_side") >= 8


def test_a_guess_is_told_and_how_to_overrule_it(tmp_path, pair):
    write_image(tmp_path / "view.png", np.hstack([pair.left, pair.right]))
    opened = open_pictures([tmp_path / "view.png"])
    assert list(map(str, opened.notes)) == ["side_by_side, detected; override it if it is wrong (format)"]
    assert_eyes(opened, pair)
    assert open_pictures([tmp_path / "view.png"], "side_by_side").notes == ()


@pytest.mark.parametrize("format", sorted(PAIR_LAYOUTS.keys() - INTERLEAVED_LAYOUTS.keys()))
def test_a_named_format_is_taken_without_a_look(tmp_path, rng, format):
    noise = rng.integers(0, 256, (80, 100, 3), dtype=np.uint8)
    write_image(tmp_path / "view.png", noise)
    opened = open_pictures([tmp_path / "view.png"], format)
    first, second = np.split(noise, 2, axis=1 if PAIR_LAYOUTS[format].beside else 0)
    if "half" not in format:
        expected = (second, first) if PAIR_LAYOUTS[format].right_first else (first, second)
        np.testing.assert_array_equal(opened.pair.left, expected[0])
        np.testing.assert_array_equal(opened.pair.right, expected[1])
    else:
        assert opened.pair.left.shape == (80, 100, 3)


@pytest.mark.parametrize("photograph", ["astronaut", "coffee", "chelsea", "rocket", "camera"])
def test_an_ordinary_photograph_is_refused_with_what_to_do(tmp_path, photograph):
    path = tmp_path / "photo.png"
    write_image(path, getattr(data, photograph)())
    message = refusal(path)
    assert message.startswith(
        f"{path}: expected a stereo picture, two views side by side or one above the other"
    )
    assert (
        "found what looks like a single photograph (its halves do not resemble each other); give two"
        in message
    )
    assert "; give two files, left and right; or choose its layout, such as side_by_side" in message
    assert message.endswith(" (format)")


@pytest.mark.parametrize("kind", [name for name in LAYOUTS if name.startswith("anaglyph")])
@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])  # red-cyan, green-magenta, blue-yellow
def test_an_anaglyph_is_named(tmp_path, pair, kind, order):
    anaglyph = LAYOUTS[kind].compose(rendered(pair), LayoutOptions())
    write_image(tmp_path / "film.png", anaglyph[..., order])
    message = refusal(tmp_path / "film.png")
    assert (
        "found an anaglyph, which mixes both views into one picture; give the two pictures it was" in message
    )
    assert message.endswith("; or choose its layout, such as side_by_side (format)")


@pytest.mark.parametrize("photograph", ["astronaut", "coffee", "chelsea", "rocket", "retina", "colorwheel"])
def test_an_ordinary_photograph_is_no_anaglyph(photograph):
    assert not looks_like_anaglyph(np.ascontiguousarray(getattr(data, photograph)()[..., :3]))


@pytest.mark.testdata
def test_a_real_anaglyph_is_named_and_real_pairs_are_not(testdata):
    assert "found an anaglyph" in refusal(testdata / "consumer" / "wikipedia.anaglyph.jpg")
    others = [
        *sorted((testdata / "stereo" / "pairs").glob("*/left.png")),
        *(testdata / "consumer").glob("*.mpo"),
    ]
    assert len(others) == 13
    others += [testdata / "consumer" / name for name in ("calf-left-right.jpg", "walrus-360.top-bottom.jpg")]
    for path in others:
        with Image.open(path) as picture:
            assert not looks_like_anaglyph(np.asarray(picture.convert("RGB"))), path


def rendered(pair):
    height, width = pair.left.shape[:2]
    flat = np.zeros((height, width), np.float32)
    estimate = Estimate(
        disparity_px=flat,
        right_disparity_px=flat,
        confidence=flat + 1,
        occluded=np.zeros((height, width), bool),
    )
    return Renderer(pair, estimate, threads=1)


@pytest.mark.parametrize("size_px", [(240, 160), (180, 240), (160, 160), (241, 161)])
@pytest.mark.parametrize(
    "name", ["side_by_side", "side_by_side_half", "crossed", "top_bottom", "top_bottom_half"]
)
def test_what_view_writes_for_two_eyes_is_read_back(tmp_path, pair, name, size_px):
    pair = StereoPair(left=shrunk(pair.left, *size_px), right=shrunk(pair.right, *size_px))
    path = add_mark(tmp_path / "view.png", name, pair, LayoutOptions())
    write_picture(path, LAYOUTS[name].compose(rendered(pair), LayoutOptions()))
    opened = open_pictures([path])
    assert opened.layout == name
    if "half" not in name:
        assert_eyes(opened, pair)
    elif size_px[0] % 2 == 0:
        assert_eyes(opened, pair, tolerance=12)


def test_the_3d_files_that_view_writes_are_read_back(tmp_path, pair):
    for name, layout in (("view.mpo", "side_by_side"), ("view.jps", "crossed")):
        write_picture(tmp_path / name, LAYOUTS[layout].compose(rendered(pair), LayoutOptions()))
        assert_eyes(open_pictures([tmp_path / name]), pair, tolerance=4)


@pytest.mark.parametrize(("name", "found"), [("quilt", "a quilt"), ("rgbd", "a picture and its depth")])
def test_what_view_writes_without_two_eyes_is_refused_by_its_name(tmp_path, pair, name, found):
    path = add_mark(tmp_path / "view.png", name, pair, LayoutOptions())
    write_image(path, np.hstack([pair.left, pair.right]))
    assert f"found {found}" in refusal(path)
    assert open_pictures([path], "side_by_side").layout == "side_by_side"


@pytest.mark.parametrize(
    ("size", "format", "found"),
    [
        ((63, 64), "side_by_side", "width of at least 64 pixels for two views, found 63x64"),
        ((62, 64), "crossed", "found 62x64"),
        ((64, 62), "top_bottom", "height of at least 64"),
        ((96, 20), "side_by_side", "expected at least 32x32 pixels, found 48x20"),
    ],
)
def test_what_cannot_be_halved_is_refused(tmp_path, size, format, found):
    path = tmp_path / "view.png"
    Image.new("RGB", size).save(path)
    message = refusal(path, format=format)
    assert message.startswith(f"{path}: ")
    assert found in message


@pytest.mark.parametrize(
    ("format", "line", "size"),
    [
        ("side_by_side", "column", "width"),
        ("crossed_half", "column", "width"),
        ("top_bottom", "row", "height"),
    ],
)
def test_an_odd_line_is_dropped_and_told(tmp_path, rng, format, line, size):
    path = tmp_path / "view.png"
    noise = rng.integers(0, 256, (97, 101, 3), dtype=np.uint8)
    write_image(path, noise)
    even = noise[:, :100] if size == "width" else noise[:96]
    write_image(tmp_path / "even.png", even)
    opened, expected = open_pictures([path], format), open_pictures([tmp_path / "even.png"], format)
    assert_eyes(opened, expected.pair)
    size_px = 101 if size == "width" else 97
    text = f"the last {line} is dropped, because the {size}, {size_px} px, is odd"
    assert list(map(str, opened.notes)) == [text]
    assert expected.notes == ()


def test_an_odd_picture_is_detected_too(tmp_path, pair):
    write_image(tmp_path / "view.png", np.hstack([pair.left, pair.right, pair.right[:, -1:]]))
    opened = open_pictures([tmp_path / "view.png"])
    assert opened.layout == "side_by_side"
    assert_eyes(opened, pair)


# Colours


def test_colours_are_converted_from_the_profile_of_the_picture(tmp_path, pair):
    swapped = profile("Swapped", SRGB[2], SRGB[1], SRGB[0])
    paths = tmp_path / "left.png", tmp_path / "right.png"
    for path, eye in zip(paths, (pair.left, pair.right), strict=True):
        Image.fromarray(eye[..., ::-1].copy()).save(path, icc_profile=swapped)
    opened = open_pictures(paths)
    assert_eyes(opened, pair, tolerance=1)
    assert list(map(str, opened.notes)) == ["colours converted from Swapped"]


def test_the_red_of_srgb_is_found_within_display_p3(tmp_path):
    # By CSS Color 4: color(srgb 1 0 0) is color(display-p3 0.917 0.200 0.139); 234, 51, 35 of 255.
    path = tmp_path / "view.png"
    Image.new("RGB", (128, 64), (234, 51, 35)).save(path, icc_profile=profile("Display P3", *DISPLAY_P3))
    opened = open_pictures([path], "side_by_side")
    np.testing.assert_allclose(opened.pair.left[5, 5].astype(int), [255, 0, 0], atol=8)
    assert list(map(str, opened.notes)) == ["colours converted from Display P3"]


def test_a_picture_in_srgb_keeps_its_values(tmp_path, pair):
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    path = tmp_path / "view.png"
    Image.fromarray(np.hstack([pair.left, pair.right])).save(path, icc_profile=own)
    opened = open_pictures([path], "side_by_side")
    assert_eyes(opened, pair)
    assert opened.notes == ()


@pytest.mark.parametrize("content", [b"nonsense" * 40, profile("Cut", *DISPLAY_P3)[:200]])
def test_a_damaged_profile_is_ignored_and_told(tmp_path, pair, content):
    path = tmp_path / "view.png"
    Image.fromarray(np.hstack([pair.left, pair.right])).save(path, icc_profile=content)
    opened = open_pictures([path], "side_by_side")
    assert_eyes(opened, pair)
    assert "the colour profile cannot be used" in opened.notes[0].text


def test_a_profile_of_one_picture_alone_is_told_with_its_side(tmp_path, pair):
    left, right = write_two(tmp_path, pair.left, pair.right)
    Image.fromarray(pair.right).save(right, icc_profile=profile("Display P3", *DISPLAY_P3))
    (note,) = open_pictures([left, right]).notes
    assert note.text == "right picture: colours converted from Display P3"


def test_a_picture_for_print_becomes_rgb(tmp_path):
    path = tmp_path / "view.jpg"
    Image.new("CMYK", (128, 64), (0, 255, 255, 0)).save(path)
    left = open_pictures([path], "side_by_side").pair.left
    np.testing.assert_allclose(left[5, 5].astype(int), [255, 0, 0], atol=3)


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "1", "I;16"])
def test_any_kind_of_pixels_becomes_rgb(tmp_path, mode):
    path = tmp_path / "view.png"
    value = {"I;16": 255 * 257}.get(mode, 1 if mode == "1" else 255)
    Image.new(mode, (128, 64), (255, 255, 255, 9)[: len(mode)] if mode in ("LA", "RGBA") else value).save(
        path
    )
    assert open_pictures([path], "side_by_side").pair.left.shape == (64, 64, 3)


# The lens


@pytest.mark.parametrize(
    ("layout", "size", "lies", "taken_px", "focal_px"),
    [
        ("side_by_side", (480, 160), 1, 480, 400),
        ("side_by_side", (480, 160), 1, 960, 200),  # scaled down by 2 since
        ("side_by_side", (480, 160), 1, 240, 400),  # the width is that of one view
        ("side_by_side", (160, 480), 6, 160, 400),  # stored upright and to be turned
        ("side_by_side_half", (240, 160), 1, 240, 400),
        ("top_bottom", (240, 320), 1, 240, 400),
    ],
)
def test_a_focal_length_on_the_sensor_is_that_of_one_view_of_a_whole_picture(
    tmp_path, layout, size, lies, taken_px, focal_px
):
    tags = tagged(lies)
    # 8 mm at 50 px per mm are 400 px of the picture as it was taken.
    tags.get_ifd(EXIF).update({FOCAL_MM: 8.0, PLANE_X: 50.0, PLANE_UNIT: 4, WIDTH_PX: taken_px})
    Image.new("RGB", size).save(tmp_path / "both.png", exif=tags)
    assert open_pictures([tmp_path / "both.png"], layout).lens.focal_px == pytest.approx(focal_px)


def test_the_lens_is_that_of_one_view_wherever_it_is_written(tmp_path, pair):
    tags = tagged(focal_35_mm=36, model="FinePix REAL 3D W3")
    expected = 36 / np.hypot(36, 24) * np.hypot(240, 160)  # 240 px for a frame of 3:2
    assert expected == pytest.approx(240)
    Image.fromarray(np.hstack([pair.left, pair.right])).save(tmp_path / "both.png", exif=tags)
    Image.fromarray(packed(pair.left, pair.right, "top_bottom_half")).save(tmp_path / "half.png", exif=tags)
    write_mpo(tmp_path / "view.mpo", pair.left, pair.right, exif=tags.tobytes())
    lenses = [
        open_pictures([tmp_path / "both.png"], "side_by_side").lens,
        open_pictures([tmp_path / "half.png"], "top_bottom_half").lens,
        open_pictures([tmp_path / "view.mpo"]).lens,
        open_pictures(write_two(tmp_path, pair.left, pair.right, tags)).lens,
        open_pictures(write_two(tmp_path, pair.left, pair.right, None, tags)).lens,
    ]
    for lens in lenses:
        assert lens.focal_px == pytest.approx(240)
        assert lens.baseline_m == 0.075


# What is not read


def box(*brands):
    content = brands[0] + bytes(4) + b"".join(brands[1:])
    return struct.pack(">L", 8 + len(content)) + b"ftyp" + content + bytes(100)


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        # Only a reader of HEIC misses the box `meta` in words.
        ("a.heic", box(b"heic", b"mif1", b"heic"), "no box 'meta', or several"),
        ("a.jpg", box(b"mif1", b"heic"), "no box 'meta', or several"),
        # In the file's head, after the version of the first brand, are 12 others.
        ("a.jpg", box(b"isom", *[b"iso2"] * 11, b"heic"), "one that cannot be read"),
        ("a.mov", box(b"qt  "), "a video; convert it as such (video)"),
        ("a.mkv", b"\x1a\x45\xdf\xa3", "a video; convert it as such (video)"),
        ("a.CR2", b"II\x2a\0", "a camera raw file"),
        ("a.dng", b"II\x2a\0", "a camera raw file"),
        ("a.jpg", b"PK\x03\x04" + bytes(1000), "another type of file"),
        ("a.jpg", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 90 90\n", "another type of file"),
        ("a.jpg", b"", "an empty file; copy it again"),
    ],
)
def test_what_is_not_read_is_refused_by_its_name(tmp_path, name, content, found):
    path = tmp_path / name
    path.write_bytes(content)
    for paths in ([path], [path, path]):
        message = refusal(*paths)
        assert message.startswith(f"{path}: expected a picture")
        assert found in message


@pytest.mark.parametrize(
    ("xmp", "found"),
    [
        (
            b'<x xmlns:GImage="http://ns.google.com/photos/1.0/image/" GImage:Mime="image/jpeg"/>',
            "found none; some programs drop it when they save or send a picture; use the original file",
        ),
        (b'<x GPano:ProjectionType="equirectangular"/>', "found 240x160 px without them"),
    ],
)
def test_an_incomplete_vr180_photo_is_refused_by_its_name(tmp_path, pair, xmp, found):
    path = tmp_path / "a.vr.jpg"
    Image.fromarray(np.hstack([pair.left, pair.right])).save(path, xmp=xmp)
    assert found in refusal(path)
    assert "found a VR180 picture or a 360-degree panorama" in refusal(path, path)


def write_animation_of(path, *images, **options):
    first, *others = (Image.fromarray(image) for image in images)
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=100,
        **({"lossless": True} if path.suffix == ".webp" else {}),
        **options,
    )
    return path


@pytest.mark.parametrize(("ending", "tolerance"), [("gif", 8), ("webp", 0), ("png", 0)])
def test_an_animation_of_two_frames_is_a_pair(tmp_path, pair, ending, tolerance):
    path = write_animation_of(tmp_path / f"a.{ending}", pair.left, pair.right)
    opened = open_pictures([path])
    assert_eyes(opened, pair, tolerance)
    assert list(map(str, opened.notes)) == [
        "an animation of two frames, taken for the left and the right view"
    ]
    with Image.open(path) as picture:
        assert pixel_factor(path, picture, None) == 2


@pytest.mark.parametrize("ending", ["webp", "png"])
def test_both_frames_of_an_animation_have_its_colour_profile(tmp_path, ending):
    red = np.full((64, 96, 3), (234, 51, 35), np.uint8)
    other = np.where(np.arange(96)[:, None] < 90, red, 0).astype(np.uint8)  # equal frames would become one
    path = write_animation_of(tmp_path / f"a.{ending}", red, other, icc_profile=profile("P3", *DISPLAY_P3))
    opened = open_pictures([path])
    np.testing.assert_allclose(opened.pair.left[5, 5].astype(int), [255, 0, 0], atol=8)
    np.testing.assert_array_equal(opened.pair.left[:, :90], opened.pair.right[:, :90])
    assert "colours converted from P3" in map(str, opened.notes)


def test_an_animation_of_two_frames_has_no_layout_and_is_no_single_picture(tmp_path, pair):
    path = write_animation_of(tmp_path / "a.gif", pair.left, pair.right)
    assert refusal(path, format="side_by_side").endswith("; omit the layout (format)")
    assert "expected one picture, found an animation of 2 frames" in refusal(path, path)


def test_a_truncated_animation_is_refused(tmp_path, pair):
    path = write_animation_of(tmp_path / "a.png", pair.left, pair.right)
    path.write_bytes(path.read_bytes()[:-20_000])
    assert re.search(r"a\.png: expected .* found .*(truncated|damaged|cannot be read)", refusal(path))


@pytest.mark.parametrize("ending", ["gif", "webp", "png"])
def test_a_longer_animation_is_refused_with_the_number_of_its_pictures(tmp_path, pair, ending):
    path = write_animation_of(tmp_path / f"a.{ending}", pair.left, pair.right, pair.left)
    assert refusal(path) == (
        f"{path}: expected one picture, or an animation of two frames, left and right, found an animation of "
        "3 frames; save its two views as separate pictures"
    )


@pytest.mark.parametrize(
    ("size_px", "views", "format", "found"),
    [
        ((40_000, 20_000), 1, None, "at most 130 megapixels, found more"),
        ((40_000, 20_000), 2, None, "at most 65 megapixels, found more"),
        ((14_000, 10_000), 1, None, "at most 130 megapixels, found 14000x10000"),
        ((10_000, 7_000), 2, None, "at most 65 megapixels, found 10000x7000"),
    ],
)
def test_too_large_a_picture_is_refused_before_it_is_decoded(tmp_path, size_px, views, format, found):
    path = tmp_path / "bomb.png"
    path.write_bytes(png_of(*size_px))
    message = refusal(*[path] * views, format=format)
    assert found in message
    assert "scale it down" in message


def test_a_picture_within_the_limit_that_is_not_whole_is_refused(tmp_path):
    path = tmp_path / "cut.png"
    path.write_bytes(png_of(400, 300))
    assert re.search(r"cut\.png: expected a picture .* found", refusal(path, format="side_by_side"))
