import io

import numpy as np
import pytest
from heic_examples import write_heic
from lif_examples import jpeg
from PIL import Image
from video_examples import TEXTURED, example_pairs, shrunk, write_side_by_side

from stereoweave.errors import FormatError
from stereoweave.io import unreadable
from stereoweave.io.images import read_image
from stereoweave.pictures.loading import open_pictures
from stereoweave.video.reader import open_video

DEPTH = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description GDepth:Format="RangeInverse" GDepth:Near="0.4"/>'
    b"</x:xmpmeta>"
)
DYNAMIC_DEPTH = b'<x:xmpmeta xmlns:Device="http://ns.google.com/photos/dd/1.0/device/"/>'


@pytest.fixture(scope="module")
def eyes():
    return tuple(shrunk(read_image(TEXTURED / f"{eye}.png"), 240, 160) for eye in ("left", "right"))


def refusal(open_it, path):
    with pytest.raises(FormatError) as caught:
        open_it([path])
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: expected ")
    assert "; " in message
    return message


@pytest.mark.parametrize(
    ("name", "found"),
    [
        (
            "a.insp",
            "found an Insta360 picture of two lenses that look in opposite directions, which is no stereo",
        ),
        (
            "a.INSV",
            "found an Insta360 video of two lenses that look in opposite directions, which is no stereo",
        ),
        ("a.360", "found a GoPro video of two lenses"),
        ("a.lfp", "found a Lytro light field; save two of its views as pictures, as Lytro Desktop does"),
        ("00001.ssif", "found a film of a 3-D Blu-ray, whose views MVC encodes together; convert it to"),
        ("film.iso", "found an image of a disc; copy the film from it, as MakeMKV does"),
        ("a.aivu", "found Apple Immersive Video; export it as VR180 or side by side"),
        ("a.braw", "found Blackmagic RAW; render it as an ordinary video"),
        ("a.r3d", "found REDCODE RAW; render it as an ordinary video"),
    ],
)
def test_each_is_named_with_the_way_to_convert_it(tmp_path, eyes, name, found):
    path = tmp_path / name
    path.write_bytes(jpeg(np.hstack(eyes)))  # what it holds does not matter
    assert found in refusal(open_pictures, path)
    assert found in refusal(open_video, path)
    path.write_bytes(b"")
    assert found in refusal(open_pictures, path)


@pytest.mark.parametrize("kind", unreadable._KINDS)
def test_every_line_says_what_to_do(tmp_path, kind):
    path = tmp_path / f"a{kind}"
    path.write_bytes(b"")
    assert refusal(open_pictures, path).split("; ")[-1].split()[0] in (
        *("export", "save", "convert", "render", "if"),
    )


@pytest.mark.parametrize("xmp", [DEPTH, DYNAMIC_DEPTH])
def test_a_portrait_with_a_depth_map_is_one_view(tmp_path, eyes, xmp):
    Image.fromarray(eyes[0]).save(tmp_path / "portrait.jpg", xmp=xmp)
    assert refusal(open_pictures, tmp_path / "portrait.jpg").endswith(
        "found a photograph of one view with a depth map, as portraits of telephones have; take a spatial "
        "photo, or give two files, left and right"
    )


def test_portraits_of_both_sides_are_a_pair(tmp_path, eyes):
    paths = [tmp_path / "left.jpg", tmp_path / "right.jpg"]
    for path, eye in zip(paths, eyes, strict=True):
        Image.fromarray(eye).save(path, xmp=DEPTH)
    assert open_pictures(paths).layout == "two_pictures"


def test_a_pair_side_by_side_with_a_depth_map_is_a_pair(tmp_path, eyes):
    Image.fromarray(np.hstack(eyes)).save(tmp_path / "both.jpg", xmp=DEPTH)
    assert open_pictures([tmp_path / "both.jpg"]).layout == "side_by_side"


def box(kind, *contents):
    body = b"".join(contents)
    return (8 + len(body)).to_bytes(4) + kind + body


def with_group(content, group):
    """Return an AVIF file with a list of groups at the end of its box `meta`."""
    at = content.index(b"meta") - 4
    size = int.from_bytes(content[at : at + 4])
    grown = (size + len(group)).to_bytes(4)
    return content[:at] + grown + content[at + 4 : at + size] + group + content[at + size :]


def avif(image):
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "AVIF", quality=90)
    return stream.getvalue()


def test_an_avif_file_with_a_stereo_group_is_named(tmp_path, eyes):
    group = box(b"grpl", box(b"ster", bytes(4), (9).to_bytes(4), (2).to_bytes(4), (1).to_bytes(4) * 2))
    path = tmp_path / "a.avif"
    path.write_bytes(with_group(avif(eyes[0]), group))
    found = "found an AVIF file with a left and a right view, of which Pillow reads one alone; save both as"
    assert found in refusal(open_pictures, path)


@pytest.mark.parametrize("group", [b"", box(b"grpl"), box(b"grpl", box(b"altr", bytes(16))), b"\0\0\1\0grpl"])
def test_other_avif_files_are_read(tmp_path, eyes, group):
    path = tmp_path / "a.avif"
    content = avif(np.hstack(eyes))
    path.write_bytes(with_group(content, b""))
    assert open_pictures([path]).layout == "side_by_side"
    # The places of the pixels, counted from the start of the file, are then wrong.
    path.write_bytes(with_group(content, group))
    try:
        open_pictures([path])
    except FormatError as error:
        assert "a left and a right view" not in str(error)


def test_a_heic_file_of_one_picture_is_still_a_single_photograph(tmp_path, eyes):
    path = write_heic(tmp_path / "a.heic", eyes[0])
    assert "found what looks like a single photograph" in refusal(open_pictures, path)


def test_a_matroska_3d_video_is_a_video(tmp_path):
    path = write_side_by_side(tmp_path / "a.mkv", example_pairs(2)).rename(tmp_path / "a.mk3d")
    assert open_video([path]).frame_count == 2
    assert "found a video" in refusal(open_pictures, path)
