import os
import struct
import sys

import numpy as np
import pytest
from raw_examples import linear_of, write_dng
from video_examples import TEXTURED, shrunk

from stereoweave.errors import FormatError
from stereoweave.io import raw
from stereoweave.io.decoding import open_picture, read_picture
from stereoweave.io.images import read_image
from stereoweave.pictures.loading import open_pictures
from stereoweave.pictures.pair_finding import find_pairs_among


@pytest.fixture(scope="module")
def eyes():
    return tuple(shrunk(read_image(TEXTURED / f"{eye}.png"), 240, 160) for eye in ("left", "right"))


def refusal(path):
    with pytest.raises(FormatError) as caught:
        read_picture(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: expected")
    return message


def patches(*, height=64, width=96):
    """Return light: a red patch at the top left of grey."""
    linear = np.full((height, width, 3), 0.214)
    linear[: height // 2, : width // 2] = 0.5, 0.1, 0.1
    return linear


def test_light_becomes_srgb(tmp_path):
    image = np.array(read_picture(write_dng(tmp_path / "a.dng", patches())).image)
    assert image.shape == (64, 96, 3)
    # By sRGB's curve 0.214 is half of the scale, 0.5 is 188 and 0.1 is 89 of 255.
    np.testing.assert_allclose(image[16, 24], (188, 89, 89), atol=1)
    np.testing.assert_allclose(image[48, 72], 127.5, atol=1)


def test_a_dark_picture_stays_dark(tmp_path):
    """The two pictures of a pair would differ if each were brightened by itself."""
    image = np.array(read_picture(write_dng(tmp_path / "a.dng", patches() / 8)).image)
    np.testing.assert_allclose(
        image[48, 72], 46, atol=1
    )  # 0.02675: 255 (1.055 * 0.02675 ** (1 / 2.4) - 0.055)


def test_the_camera_s_white_balance_is_applied(tmp_path):
    path = write_dng(tmp_path / "a.dng", patches(), neutral=(0.5, 1.0, 0.8))
    np.testing.assert_allclose(np.array(read_picture(path).image)[48, 72], 127.5, atol=2)


@pytest.mark.parametrize(("lies", "red"), [(1, (0, 0)), (3, (1, 1)), (6, (0, 1)), (8, (1, 0))])
def test_a_raw_file_is_turned_upright_once(tmp_path, lies, red):
    path = write_dng(tmp_path / "a.dng", patches(), orientation=lies)
    opened = open_pictures([path, path])
    image = opened.pair.left
    assert image.shape == ((64, 96, 3) if lies in (1, 3) else (96, 64, 3))
    corner = image[[8, -8][red[0]], [8, -8][red[1]]]
    np.testing.assert_allclose(corner, (188, 89, 89), atol=1)
    assert opened.notes == ()


def test_two_raw_files_are_a_pair(tmp_path, eyes):
    paths = [
        write_dng(tmp_path / f"{side}.DNG", linear_of(eye))
        for side, eye in zip(("left", "right"), eyes, strict=True)
    ]
    opened = open_pictures(paths)
    for found, taken in ((opened.pair.left, eyes[0]), (opened.pair.right, eyes[1])):
        assert found.shape == taken.shape
        assert np.abs(found.astype(int) - taken).mean() < 8  # two of three colours are interpolated


def test_a_raw_file_tells_its_camera(tmp_path):
    with open_picture(write_dng(tmp_path / "a.dng", patches(), orientation=6)) as picture:
        assert (picture.format, picture.size) == ("RAW", (64, 96))
        assert picture.getexif()[0x0110] == "Test camera"
        assert 0x0112 not in picture.getexif()


def test_a_raw_file_is_recognised_without_its_ending(tmp_path):
    """The service stores uploads without one. Pillow would open the sensor's values as a grey picture."""
    path = write_dng(tmp_path / "a.dng", patches()).rename(tmp_path / "left")
    np.testing.assert_allclose(np.array(read_picture(path).image)[16, 24], (188, 89, 89), atol=1)


@pytest.mark.parametrize(
    "head",
    [
        *(b"FUJIFILMCCD-RAW 0201", b"IIU\0\x18\0\0\0", b"IIRO\x08\0\0\0", b"MMOR\0\0\0\x08", b"FOVb\0\0\2\0"),
        *(
            b"II\x1a\0\0\0HEAPCCDR",
            b"II*\0\x10\0\0\0CR\2\0",
            b"\0\0\0\x18ftypcrx \0\0\0\1crx isom",
            b"\0MRM\0",
        ),
    ],
)
def test_raw_files_of_other_makers_are_recognised_by_their_beginning(tmp_path, head):
    (tmp_path / "left").write_bytes(head + bytes(500))
    assert "found a camera raw file that LibRaw cannot read (" in refusal(tmp_path / "left")


def test_a_raw_file_with_a_picture_of_its_name_is_left_out_of_a_folder():
    pairs = find_pairs_among(
        "shots", ["a_L.dng", "a_R.dng", "b_L.jpg", "b_L.NEF", "b_R.jpg", "b_R.NEF"]
    ).pairs
    assert [pair.files for pair in pairs] == [("a_L.dng", "a_R.dng"), ("b_L.jpg", "b_R.jpg")]


def test_without_rawpy_the_extra_is_named(tmp_path, monkeypatch):
    path = write_dng(tmp_path / "a.dng", patches())
    monkeypatch.setitem(sys.modules, "rawpy", None)
    message = refusal(path)
    assert "found a camera raw file, which needs rawpy, but the module rawpy is not installed" in message
    assert message.endswith('pip install "stereoweave[raw]"')


# Damaged and odd files


@pytest.mark.parametrize("ending", sorted(raw.ENDINGS))
def test_what_is_no_raw_file_is_refused(tmp_path, ending):
    for content in (b"", b"II\x2a\0", b"\0" * 5000, b"\x89PNG\r\n\x1a\n" + bytes(500)):
        path = tmp_path / f"a{ending}"
        path.write_bytes(content)
        assert "found a camera raw file that LibRaw cannot read (" in refusal(path)


def entry_of(content, tag):
    """Return where the value of a tag begins."""
    start = struct.unpack_from("<L", content, 4)[0]
    (count,) = struct.unpack_from("<H", content, start)
    for at in range(start + 2, start + 2 + 12 * count, 12):
        if struct.unpack_from("<H", content, at)[0] == tag:
            return at + 8
    raise AssertionError(tag)


@pytest.mark.parametrize(
    ("width_px", "height_px"), [(60_000, 60_000), (40_000, 40), (0, 64), (96, 0), (2**31, 2**31), (1, 1)]
)
def test_a_false_size_is_refused_before_memory_is_taken(tmp_path, width_px, height_px):
    path = write_dng(tmp_path / "a.dng", patches())
    content = bytearray(path.read_bytes())
    for tag, size_px in ((256, width_px), (257, height_px)):
        at = entry_of(content, tag)
        struct.pack_into("<HHL", content, at - 8, tag, 4, 1)
        struct.pack_into("<L", content, at, size_px)
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        open_pictures([path, path])
    assert "\n" not in str(caught.value)
    if (width_px, height_px) == (60_000, 60_000):
        assert "found 60000x60000; scale it down" in str(caught.value)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_a_raw_file_that_was_cut_off_is_refused(tmp_path, share, capfd):
    path = write_dng(tmp_path / "a.dng", patches())
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refusal(path)
    assert capfd.readouterr().err == ""  # LibRaw would write a line of its own
    os.write(2, b"heard again")
    assert capfd.readouterr().err == "heard again"


def test_empty_last_rows_are_named(tmp_path):
    """Some programs fill up what they could not copy."""
    path = write_dng(tmp_path / "a.dng", patches())
    content = path.read_bytes()
    path.write_bytes(content[: int(0.9 * len(content))] + bytes(len(content) - int(0.9 * len(content))))
    assert "found a camera raw file whose last rows are empty; copy it again" in refusal(path)


def test_a_dark_picture_is_no_empty_one(tmp_path):
    linear = np.zeros((64, 96, 3))
    linear[::7, ::5] = 2e-5  # a single level of the sensor
    assert np.array(read_picture(write_dng(tmp_path / "a.dng", linear)).image).max() <= 1


def test_damage_at_random_is_one_line_or_a_picture(tmp_path, rng):
    path = write_dng(tmp_path / "a.dng", patches())
    whole = path.read_bytes()
    for _ in range(40):
        content = bytearray(whole)
        for at in rng.integers(0, 700, 6):
            content[at] = rng.integers(0, 256)
        path.write_bytes(content)
        try:
            read_picture(path)
        except FormatError as error:
            assert "\n" not in str(error)


def test_raw_files_of_two_sizes_are_refused(tmp_path):
    paths = [
        write_dng(tmp_path / f"{index}.dng", patches(width=width)) for index, width in enumerate((96, 120))
    ]
    with pytest.raises(FormatError, match=r"120x64"):
        open_pictures(paths)
