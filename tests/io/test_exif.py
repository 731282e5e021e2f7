import math
import struct

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from stereoweave.errors import StereoweaveError
from stereoweave.io import exif

EXIF, MODEL, ORIENTATION = 0x8769, 0x0110, 0x0112
FOCAL_MM, FOCAL_35_MM, WIDTH_PX, PLANE_X, PLANE_UNIT = 0x920A, 0xA405, 0xA002, 0xA20E, 0xA210


def tags_of(path, tags=(), model=None, lies=None):
    """Save a JPEG with these tags and return the tags that are read from it."""
    written = Image.Exif()
    written.get_ifd(EXIF).update(tags)
    if model:
        written[MODEL] = model
    if lies:
        written[ORIENTATION] = lies
    Image.new("RGB", (40, 32)).save(path, exif=written)
    with Image.open(path) as picture:
        return exif.read_tags(picture)


def multi_picture(number=None, baseline=None):
    """Return a Multi-Picture Format header with a viewpoint, and a baseline as a fraction in metres."""
    entries = [struct.pack("<HHLL", 0xB101, 4, 1, number)] if number else []
    after = 8 + 2 + 12 * (len(entries) + 1) + 4
    if baseline:
        entries.append(struct.pack("<HHLL", 0xB206, 5, 1, after))
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    return b"II\x2a\x00" + struct.pack("<L", 8) + directory + struct.pack("<LL", *(baseline or (0, 0)))


def test_a_focal_length_on_film_gives_the_same_diagonal_angle_of_view(tmp_path):
    tags = tags_of(tmp_path / "a.jpg", {FOCAL_35_MM: 26})
    # 4000x3000 has a diagonal of 5000 px, 36 mm x 24 mm one of 43.267 mm.
    lens = exif.read_lens(tags, 4000, 3000)
    assert lens.focal_px == pytest.approx(26 * 5000 / 43.2666, rel=1e-5)
    assert lens.baseline_m is None
    # A full-frame camera: 36 mm are 6000 px.
    assert exif.read_lens(tags, 6000, 4000).focal_px == pytest.approx(26 * 6000 / 36, rel=1e-5)
    assert exif.read_lens(tags, 3000, 4000) == lens


def test_a_focal_length_in_mm_needs_the_sensor_density_and_scales_with_the_picture(tmp_path):
    # 6.3 mm at 5000 px per cm are 3150 px of the original picture, which was 3648 px wide.
    tags = {
        FOCAL_MM: IFDRational(63, 10),
        PLANE_X: IFDRational(5000, 1),
        PLANE_UNIT: 3,
        WIDTH_PX: 3648,
    }
    assert exif.read_lens(tags_of(tmp_path / "a.jpg", tags), 3648, 2736).focal_px == pytest.approx(3150)
    assert exif.read_lens(tags_of(tmp_path / "a.jpg", tags), 1824, 1368).focal_px == pytest.approx(1575)
    inches = tags | {PLANE_UNIT: 2, PLANE_X: IFDRational(12700, 1)}
    assert exif.read_lens(tags_of(tmp_path / "a.jpg", inches), 3648, 2736).focal_px == pytest.approx(3150)
    for lacking in tags:
        some = {tag: value for tag, value in tags.items() if tag not in (lacking, PLANE_UNIT)}
        if lacking != PLANE_UNIT:
            assert exif.read_lens(tags_of(tmp_path / "a.jpg", some), 3648, 2736) is None


def test_the_focal_length_on_film_is_preferred_because_rescaling_keeps_it(tmp_path):
    tags = {FOCAL_35_MM: 36, FOCAL_MM: IFDRational(5, 1), PLANE_X: IFDRational(1, 1), WIDTH_PX: 10}
    assert exif.read_lens(tags_of(tmp_path / "a.jpg", tags), 600, 400).focal_px == pytest.approx(600)


@pytest.mark.parametrize("value", [0, 65535.5])
def test_an_unknown_or_invalid_focal_length_is_none(tmp_path, value):
    assert exif.read_lens({FOCAL_35_MM: 0}, 40, 32) is None
    assert exif.read_lens({FOCAL_MM: IFDRational(1, 0), PLANE_X: "text", WIDTH_PX: value}, 40, 32) is None


def test_an_implausible_focal_length_is_ignored():
    # 4000x3000 has a diagonal of 5000 px: 65535 mm on film are 7.6 million px, 10 mm at 1 px a mm are 10 px.
    assert exif.read_lens({FOCAL_35_MM: 65535}, 4000, 3000) is None
    sensor = {FOCAL_MM: 10, PLANE_UNIT: 4, WIDTH_PX: 4000}
    assert exif.read_lens(sensor | {PLANE_X: 1}, 4000, 3000) is None
    both = sensor | {PLANE_X: 400, FOCAL_35_MM: 65535}
    assert exif.read_lens(both, 4000, 3000).focal_px == pytest.approx(4000)
    # A round fisheye lens and a telescope.
    assert exif.read_lens({FOCAL_35_MM: 7}, 4000, 3000).focal_px == pytest.approx(809, abs=1)
    assert exif.read_lens({FOCAL_35_MM: 2000}, 4000, 3000).focal_px == pytest.approx(231_125, abs=1)


def test_the_baseline_of_an_mpo_frame_is_read_in_metres():
    picture = Image.new("RGB", (40, 32))
    picture.info["mp"] = multi_picture(2, (77, 1000))
    tags = exif.read_tags(picture)
    assert exif.read_viewpoint(tags) == 2
    assert exif.read_lens(tags, 40, 32) == exif.Lens(baseline_m=0.077)


def test_an_unknown_baseline_is_none_and_not_one_metre():
    picture = Image.new("RGB", (40, 32))
    picture.info["mp"] = multi_picture(baseline=(0xFFFFFFFF, 0xFFFFFFFF))  # "unknown" in CIPA DC-007
    assert exif.read_lens(exif.read_tags(picture), 40, 32) is None


@pytest.mark.parametrize(
    ("model", "baseline_m"),
    [("FinePix REAL 3D W1", 0.077), ("FinePix REAL 3D W3", 0.075), ("Nintendo 3DS", 0.035)],
)
def test_known_cameras_that_do_not_store_their_baseline_have_one(tmp_path, model, baseline_m):
    tags = tags_of(tmp_path / "a.jpg", model=model)
    assert exif.read_lens(tags, 40, 32) == exif.Lens(baseline_m=baseline_m)
    assert exif.read_lens(tags_of(tmp_path / "a.jpg", model="Some phone"), 40, 32) is None


def test_a_picture_without_tags_has_no_lens_or_orientation():
    tags = exif.read_tags(Image.new("RGB", (40, 32)))
    assert tags == {}
    assert exif.read_orientation(tags) is None
    assert exif.read_lens(tags, 40, 32) is None


def test_damaged_tags_raise_no_error(rng):
    written = Image.Exif()
    written.get_ifd(EXIF).update({FOCAL_35_MM: 26, FOCAL_MM: IFDRational(63, 10)})
    written[ORIENTATION] = 6
    whole, header = written.tobytes(), multi_picture(1, (77, 1000))
    for content, key in ((whole, "exif"), (header, "mp")):
        for _ in range(200):
            spoiled = np.frombuffer(content, np.uint8).copy()
            spoiled[rng.integers(4, len(spoiled), 3)] = rng.integers(0, 256, 3)
            picture = Image.new("RGB", (40, 32))
            picture.info[key] = spoiled.tobytes()[: rng.integers(1, len(spoiled) + 1)]
            tags = exif.read_tags(picture)
            exif.read_lens(tags, 40, 32)
            exif.read_orientation(tags)


@pytest.mark.parametrize(
    ("lies", "upright"),
    [
        # EXIF states where the stored first row and first column belong: "right" and "top" for 6.
        (1, "ab/cd"),
        (2, "ba/dc"),
        (3, "dc/ba"),
        (4, "cd/ab"),
        (5, "ac/bd"),
        (6, "ca/db"),
        (7, "db/ca"),
        (8, "bd/ac"),
    ],
)
def test_a_picture_is_turned_upright_from_each_of_the_eight_orientations(tmp_path, lies, upright):
    stored = Image.fromarray(np.array([[ord("a"), ord("b")], [ord("c"), ord("d")]], np.uint8))
    assert exif.read_orientation(tags_of(tmp_path / "a.jpg", lies=lies)) == lies
    rows = np.asarray(exif.turn_upright(stored, lies)).tolist()
    assert "/".join("".join(map(chr, row)) for row in rows) == upright


@pytest.mark.parametrize("lies", [None, 0, 9, "6", (1, 2)])
def test_an_invalid_orientation_leaves_the_picture_unchanged(lies):
    assert exif.read_orientation({} if lies is None else {ORIENTATION: lies}) is None


@pytest.mark.parametrize("nonsense", [0.0, -1.0, math.inf, math.nan])
def test_an_impossible_lens_is_refused(nonsense):
    with pytest.raises(StereoweaveError, match="must be positive"):
        exif.Lens(focal_px=nonsense)
    with pytest.raises(StereoweaveError, match="must be positive"):
        exif.Lens(baseline_m=nonsense)
