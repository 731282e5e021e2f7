"""Every entry point reads the same picture formats, with the same limits, colours and errors."""

import io
import os
import re
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fastapi import UploadFile
from picture_examples import SRGB, png_of, profile
from PIL import Image

import stereoweave
from stereoweave.app import session as page_kept
from stereoweave.bench.view_scenes import list_view_scenes
from stereoweave.cameras.boards import Board
from stereoweave.cameras.calibrate import calibrate
from stereoweave.cli.root import main
from stereoweave.data.readers import list_scenes
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.images import read_image, read_pair, write_image
from stereoweave.io.maps import read_disparity_png, read_pfm, read_pixels
from stereoweave.matching.backend import Backend
from stereoweave.pictures.loading import open_pictures
from stereoweave.pictures.prepare import Request, prepare
from stereoweave.service.answers import check_pixels
from stereoweave.service.forms import MapForm, store_uploads
from stereoweave.stereo import StereoPair
from stereoweave.video.reader import open_video

ORIENTATION = 0x0112


@pytest.fixture
def picture():
    """Return a smooth image that differs in every channel and direction; both views are the same."""
    y, x = np.mgrid[:64, :96]
    return np.stack([2 * x, 3 * y, 255 - x - 2 * y], axis=-1).astype(np.uint8)


def refusal(function, *arguments):
    """Return the one-line message of the FormatError that the call must raise."""
    with pytest.raises(FormatError) as caught:
        function(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    return message


def encoded(image, kind, **options):
    out = io.BytesIO()
    Image.fromarray(image).save(out, kind, **options)
    return out.getvalue()


# Agreement of all entry points


def by_service(folder: Path):
    contents = {side: io.BytesIO((folder / f"{side}.png").read_bytes()) for side in ("left", "right")}
    uploads = {side: UploadFile(content) for side, content in contents.items()}
    (folder / "request").mkdir(exist_ok=True)
    order = store_uploads(MapForm(**uploads), folder / "request", "disparity.png", 65)
    check_pixels(order)
    return prepare(order.pictures, order.request).pair


def by_page(folder: Path):
    pictures = folder / "left.png", folder / "right.png"
    uploads = page_kept.Uploads(pictures=pictures, request=Request(), backend=Backend())
    return page_kept.match_uploads(uploads, lambda *_: None).pair


def by_video(folder: Path):
    video = open_video([folder / "frames" / f"{side}_*.png" for side in ("left", "right")])
    frame = next(iter(video.frames()))
    return StereoPair(left=frame.left, right=frame.right)


# The result of each entry point for a folder's left.png and right.png.
WAYS: dict[str, Callable[[Path], StereoPair]] = {
    "read_image": lambda folder: StereoPair(
        left=read_image(folder / "left.png"), right=read_image(str(folder / "right.png"))
    ),
    "read_pair": lambda folder: read_pair(folder / "left.png", folder / "right.png"),
    "commands": lambda folder: open_pictures([folder / "left.png", folder / "right.png"]).pair,
    "video": by_video,
    "bench pairs": lambda folder: list_scenes(folder.parent)[0]().pair,
    "bench views": lambda folder: list_view_scenes(folder.parent)[0]().sample,
    "service": by_service,
    "page": by_page,
}


def fill(folder: Path, content: bytes) -> Path:
    """Return the folder with this content as the left and the right picture, for all entry points."""
    (folder / "frames").mkdir(parents=True)
    names = ("left.png", "right.png", "view_0.5.png", "frames/left_0.png", "frames/right_0.png")
    for name in names:
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("way", WAYS)
def test_every_entry_point_turns_a_picture_upright_and_converts_its_colours(tmp_path, picture, way):
    tags = Image.Exif()
    tags[ORIENTATION] = 6
    lying = np.rot90(picture)[..., ::-1].copy()  # needs a clockwise rotation; red and blue are swapped
    swapped = profile("Swapped", SRGB[2], SRGB[1], SRGB[0])
    folder = fill(tmp_path / "scene", encoded(lying, "PNG", exif=tags, icc_profile=swapped))
    Image.new("I;16", (96, 64), 256).save(folder / "disparity.png")
    pair = WAYS[way](folder)
    np.testing.assert_allclose(pair.left.astype(int), picture, atol=2)
    np.testing.assert_array_equal(pair.right, pair.left)


def test_a_png_with_an_icc_profile_has_the_same_pixels_in_every_entry_point(tmp_path):
    swapped = profile("Swapped", SRGB[2], SRGB[1], SRGB[0])
    image = np.full((64, 96, 3), (200, 60, 60), np.uint8)
    folder = fill(tmp_path / "scene", encoded(image, "PNG", icc_profile=swapped))
    Image.new("I;16", (96, 64), 256).save(folder / "disparity.png")
    pixels = {way: read(folder).left for way, read in WAYS.items()}
    np.testing.assert_allclose(pixels["read_image"].astype(int), image[..., ::-1], atol=2)
    for way in WAYS:
        np.testing.assert_array_equal(pixels[way], pixels["read_image"], err_msg=way)


def by_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["check", str(folder / "left.png"), str(folder / "right.png")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def by_boards(folder: Path) -> str:
    with pytest.raises(StereoweaveError) as caught:
        calibrate(folder, Board(columns=9, rows=6, square_m=0.025))
    return str(caught.value)


def test_every_entry_point_refuses_a_damaged_picture_with_the_same_words(tmp_path, picture, capsys):
    content = encoded(np.tile(picture, (4, 4, 1)), "PNG")
    folder = fill(tmp_path / "scene", content[:1500])
    Image.new("I;16", (384, 256), 256).save(folder / "disparity.png")
    messages = {way: refusal(WAYS[way], folder) for way in WAYS}
    messages |= {"command": by_command(folder, capsys), "boards": by_boards(folder)}
    expected = (
        "expected a picture (PNG, JPEG, TIFF or the like), found one that cannot be read (image file is"
    )
    assert {way: message for way, message in messages.items() if expected not in message} == {}


def test_no_other_module_opens_pictures():
    package = Path(stereoweave.__file__).parent
    opening = re.compile(r"\b(Image\.open|cv2\.imread|imageio\.\w+|ImageOps\.exif_transpose)\(")
    found = [path.name for path in package.rglob("*.py") if opening.search(path.read_text(encoding="utf-8"))]
    assert found == ["decoding.py"]


# Formats


def test_postscript_with_the_ending_of_a_picture_is_refused(tmp_path):
    path = tmp_path / "left.png"
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 90 90\n%%EndComments\nshowpage\n")
    for read in (read_image, read_disparity_png, lambda at: read_pixels(at, "RGB")):
        assert refusal(read, path).endswith("found another type of file; save it as PNG or JPEG")


def test_read_image_refuses_an_animation(tmp_path, picture):
    path = tmp_path / "a.gif"
    path.write_bytes(encoded(picture, "GIF", save_all=True, append_images=[Image.fromarray(255 - picture)]))
    assert "an animation of 2" in refusal(read_image, path)


@pytest.mark.parametrize(
    ("mode", "colour", "expected"),
    [
        ("1", 1, 255),
        ("L", 90, 90),
        ("LA", (90, 9), 90),
        ("RGBA", (90, 90, 90, 0), 90),
        ("P", 0, 0),
        ("CMYK", (0, 0, 0, 165), 90),
        ("I;16", 90 * 256, 90),
        ("I", 90 * 257, 90),
    ],
)
def test_grey_is_the_same_in_every_pixel_format(tmp_path, mode, colour, expected):
    path = tmp_path / "grey.tif"
    Image.new(mode, (40, 40), colour).save(path)
    np.testing.assert_array_equal(read_image(path), np.full((40, 40, 3), expected, np.uint8))


# Limits


@pytest.mark.parametrize(
    ("size_px", "found"),
    [
        ((10_000, 7_000), "at most 65 megapixels, found 10000x7000"),
        ((40_000, 20_000), "at most 65 megapixels, found more"),
        ((64, 32_767), "at most 32766 pixels per side, found 64x32767"),
        ((32_767, 64), "at most 32766 pixels per side, found 32767x64"),
    ],
)
def test_too_large_a_picture_is_refused_before_it_is_decoded(tmp_path, size_px, found):
    path = tmp_path / "large.png"
    path.write_bytes(png_of(*size_px))
    for read in (read_image, read_disparity_png, lambda at: read_pixels(at, "L")):
        assert found in refusal(read, path)


@pytest.mark.parametrize("size_px", [(32, 32_766), (32_766, 32)])
def test_a_picture_of_the_greatest_length_is_read_and_checked(tmp_path, size_px, rng, capsys):
    width, height = size_px
    paths = [str(tmp_path / f"{side}.png") for side in ("left", "right")]
    noise = np.zeros((height, width + 4, 3), np.uint8)
    noise[:1000, :1000] = rng.integers(0, 256, noise[:1000, :1000].shape, dtype=np.uint8)
    for path, eye in zip(paths, (noise[:, :-4], noise[:, 4:]), strict=True):
        write_image(path, np.ascontiguousarray(eye))
    assert main(["check", *paths]) in (0, 1)
    assert all(line.endswith(" …") for line in capsys.readouterr().err.splitlines())  # only steps


def test_one_picture_may_hold_two_views_of_the_greatest_length(tmp_path):
    path = tmp_path / "both.png"
    Image.new("L", (2 * 32_766, 32)).save(path)
    assert open_pictures([path], "side_by_side").pair.left.shape == (32, 32_766, 3)
    assert "at most 32766 pixels per side, found 65532x32" in refusal(
        lambda: open_pictures([path], "side_by_side_half")
    )


# Paths that are not regular files

PROGRAM = """
import sys
from stereoweave.cli.root import main
from stereoweave.io.images import read_image
from stereoweave.io.maps import read_disparity_png, read_pfm
for path in (*sys.argv[1:], "a\\0b.png"):
    for read in (read_image, read_disparity_png, read_pfm):
        try:
            read(path)
        except ValueError as error:
            print(type(error).__name__, error)
    main(["check", path, path])
"""


def test_a_pipe_a_device_a_loop_and_an_invalid_name_are_one_line_errors_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "loop.png").symlink_to(tmp_path / "loop.png")
    paths = [tmp_path / "pipe.png", "/dev/zero", tmp_path / "loop.png", tmp_path, tmp_path / "none.png"]
    command = [sys.executable, "-c", PROGRAM, *map(str, paths)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    lines = [*ended.stdout.splitlines(), *ended.stderr.splitlines()]
    assert len(lines) == 4 * 6
    for line, found in zip(
        lines[: 3 * 6 : 3],
        ("a pipe or a device", "a pipe or a device", "symbolic links", "a folder", "no such file", "null"),
        strict=True,
    ):
        assert line.startswith("FormatError") and found in line
    assert all(line.startswith(("FormatError ", "stereoweave: ")) for line in lines)


def test_a_damaged_tiff_prints_nothing_but_its_error(tmp_path):
    # 65,535 samples per pixel, which Pillow logs before it raises an error.
    tags = [(256, 4, 40), (257, 4, 40), (258, 3, 8), (262, 3, 1), (273, 4, 8), (277, 3, 65535), (279, 4, 99)]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    path = tmp_path / "left.tif"
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(200))
    command = [sys.executable, "-m", "stereoweave", "check", str(path), str(path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.stderr.startswith(f"stereoweave: {path}: expected a picture")
    assert ended.stderr.count("\n") == 1


# Damage

KINDS = {
    "PNG": {},
    "JPEG": {},
    "TIFF": {},
    "WEBP": {},
    "BMP": {},
    "GIF": {},
    "PPM": {},
    "JPEG2000": {},
    "AVIF": {"speed": 10},
    "MPO": {"save_all": True},
}


def read_in_all_ways(path: Path) -> int:
    """Return the number of readers that refuse the file; each must return an image or raise FormatError."""
    refused = 0
    for read in (
        read_image,
        read_disparity_png,
        lambda at: read_pixels(at, "L", "RGB"),
        lambda at: open_pictures([at, at]),
        lambda at: open_pictures([at], "side_by_side"),
        lambda at: open_pictures([at]),
    ):
        try:
            read(path)
        except StereoweaveError as error:
            assert "\n" not in str(error)
            refused += 1
    return refused


@pytest.mark.parametrize("kind", KINDS)
def test_wherever_a_picture_is_cut_or_changed_it_is_read_or_refused(tmp_path, rng, kind):
    y, x = np.mgrid[:32, :64]
    image = np.stack([4 * x, 8 * y, 255 - 4 * x], axis=-1).astype(np.uint8)
    more = {"append_images": [Image.fromarray(image[::-1].copy())]} if kind == "MPO" else {}
    whole = encoded(image, kind, **KINDS[kind], **more)
    path = tmp_path / "changed"
    refused = 0
    for place in np.linspace(0, len(whole) - 1, 40).astype(int):
        path.write_bytes(whole[:place])
        refused += read_in_all_ways(path)
    for place in rng.integers(0, len(whole), 40):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        refused += read_in_all_ways(path)
    assert refused > 40


def test_an_mpo_file_cut_within_the_head_of_its_second_picture_is_refused(tmp_path, picture):
    second = Image.fromarray(picture[::-1].copy())
    whole = encoded(picture, "MPO", save_all=True, append_images=[second])
    start = whole.index(b"\xff\xd8", 2)
    path = tmp_path / "cut.mpo"
    for length in range(start, start + 150):
        path.write_bytes(whole[:length])
        assert "found that picture 2 is truncated or damaged" in refusal(open_pictures, [path])


@pytest.mark.parametrize("mark", [b"!", b","])
def test_a_gif_that_is_cut_where_another_picture_begins_is_refused(tmp_path, picture, mark):
    path = tmp_path / "damaged.gif"
    path.write_bytes(encoded(picture, "GIF").removesuffix(b";") + mark)
    for read in (read_image, lambda at: open_pictures([at]), lambda at: read_pixels(at, "P")):
        assert "found one that cannot be read" in refusal(read, path)


# PFM


@pytest.mark.parametrize(
    ("header", "found"),
    [
        (b"Pf\n1000000000 1000000000\n-1.0\n", "found b'Pf"),
        (b"Pf\n100000000 100000000\n-1.0\n", "at most 65 megapixels, found 100000000x100000000"),
        (b"Pf\n" + b"9" * 5000 + b" 3\n-1.0\n", "found b'Pf"),
        (b"Pf\n-2 -2\n-1.0\n", "found b'Pf"),
        (b"Pf\n0 0\n-1.0\n", "at least one pixel"),
        (b"Pf\n2 2\nnan\n", "a finite scale other than 0"),
        (b"Pf\n2 2\ninf\n", "a finite scale other than 0"),
        (b"Pf\n2 2\n0\n", "a finite scale other than 0"),
        (b"Pf\n1 32767\n-1.0\n", "at most 32766 pixels per side"),
    ],
)
def test_a_pfm_file_with_an_invalid_header_is_refused(tmp_path, header, found):
    path = tmp_path / "map.pfm"
    path.write_bytes(header + bytes(16))
    assert found in refusal(read_pfm, path)


def test_a_pfm_file_longer_than_its_header_says_is_not_read_into_memory(tmp_path):
    path = tmp_path / "map.pfm"
    with path.open("wb") as file:
        file.write(b"Pf\n2 2\n-1.0\n")
        file.truncate(2**40)  # a sparse file, which takes no space on the disk
    assert "expected 16 bytes for 2x2 values" in refusal(read_pfm, path)
