import numpy as np
import pytest
from PIL import Image
from skimage import data
from video_examples import TEXTURED, interleaved, shrunk

from stereoweave.errors import FormatError
from stereoweave.io.images import read_image, write_image
from stereoweave.pictures.interleaved import INTERLEAVED_LAYOUTS, suspect_interleaving
from stereoweave.pictures.loading import open_pictures

KINDS = ["row_interleaved", "column_interleaved", "checkerboard"]


@pytest.fixture(scope="module")
def eyes():
    return tuple(shrunk(read_image(TEXTURED / f"{eye}.png"), 480, 320) for eye in ("left", "right"))


def refusal(path, format=None):
    with pytest.raises(FormatError) as caught:
        open_pictures([path], format)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: expected")
    return message


@pytest.mark.parametrize("kind", KINDS)
def test_a_view_keeps_its_own_pixels_in_their_places(rng, kind):
    left, right = rng.integers(0, 256, (2, 64, 72, 3), np.uint8)
    found = INTERLEAVED_LAYOUTS[kind].eyes(interleaved(left, right, kind))
    own = {
        "row_interleaved": [np.s_[::2], np.s_[1::2]],
        "column_interleaved": [np.s_[:, ::2], np.s_[:, 1::2]],
        "checkerboard": [np.s_[::2, ::2], np.s_[::2, 1::2]],
    }[kind]
    for eye, taken, place in zip(found, (left, right), own, strict=True):
        assert eye.shape == (64, 72, 3)
        np.testing.assert_array_equal(eye[place], taken[place])


@pytest.mark.parametrize("kind", KINDS)
def test_a_slope_is_continued_between_the_pixels_without_a_shift(kind):
    """Cubic interpolation is exact on a slope, so neither view is moved up, down or sideways."""
    y, x = np.mgrid[:70, :80]
    slope = np.repeat((2 * y + x)[..., None], 3, axis=2).astype(np.uint8)
    for eye in INTERLEAVED_LAYOUTS[kind].eyes(interleaved(slope, slope, kind)):
        np.testing.assert_array_equal(eye[3:-3, 3:-3], slope[3:-3, 3:-3])


def test_a_missing_row_is_nine_sixteenths_of_each_neighbour_less_a_sixteenth_of_the_next_ones():
    rows = np.zeros((64, 64, 3), np.uint8)
    rows[20], rows[22] = 160, 160
    left, right = INTERLEAVED_LAYOUTS["row_interleaved"].eyes(rows)
    assert [left[at, 5, 0] for at in (19, 21, 23, 25)] == [80, 180, 80, 0]  # (9 - 1) / 16, 18 / 16 of 160
    assert right.max() == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_view_borders_on_its_own_pixels_only(kind):
    black, white = np.zeros((65, 67, 3), np.uint8), np.full((65, 67, 3), 255, np.uint8)
    left, right = INTERLEAVED_LAYOUTS[kind].eyes(interleaved(black, white, kind))
    assert left.max() == 0
    assert right.min() == 255


@pytest.mark.parametrize("kind", KINDS)
def test_the_right_view_may_come_first(eyes, kind):
    left, right = eyes
    expected = INTERLEAVED_LAYOUTS[kind].eyes(interleaved(left, right, kind))
    other = INTERLEAVED_LAYOUTS[f"{kind}_right_first"]
    assert INTERLEAVED_LAYOUTS[kind].swapped() == other
    for found, taken in zip(other.eyes(interleaved(left, right, kind)), expected[::-1], strict=True):
        np.testing.assert_array_equal(found, taken)


@pytest.mark.parametrize("kind", KINDS)
def test_an_interleaved_picture_is_read_by_its_format(tmp_path, eyes, kind):
    write_image(tmp_path / "a.png", interleaved(*eyes, kind))
    opened = open_pictures([tmp_path / "a.png"], kind)
    assert (opened.layout, opened.notes) == (kind, ())
    for found, taken in zip((opened.pair.left, opened.pair.right), eyes, strict=True):
        assert found.shape == taken.shape
        assert np.abs(found.astype(int) - taken).mean() < 6


@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_suspected_one_is_refused_with_its_name(tmp_path, eyes, kind, ending):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(interleaved(*eyes, kind)).save(path)
    message = refusal(path)
    assert f"found what looks like {kind}, or a frame of interlaced video in motion" in message
    assert f"or choose its layout, such as {kind}" in message
    assert "(format)" in message


@pytest.mark.parametrize("photograph", ["astronaut", "coffee", "chelsea", "rocket", "brick", "gravel"])
def test_no_photograph_is_suspected(photograph):
    image = getattr(data, photograph)()
    image = np.dstack([image] * 3) if image.ndim == 2 else image
    assert suspect_interleaving(np.ascontiguousarray(image)) is None


@pytest.mark.testdata
def test_no_real_photograph_is_suspected(testdata):
    pictures = sorted(testdata.glob("stereo/pairs/*/left.*"))
    assert len(pictures) >= 12
    found = {str(path): suspect_interleaving(read_image(path)) for path in pictures}
    assert {path: kind for path, kind in found.items() if kind} == {}


@pytest.mark.parametrize("kind", [*INTERLEAVED_LAYOUTS])
@pytest.mark.parametrize("size_px", [(1, 1), (2, 500), (500, 2), (63, 500), (500, 63)])
def test_pictures_too_small_for_two_views_are_refused(tmp_path, kind, size_px):
    Image.new("RGB", size_px).save(tmp_path / "a.png")
    found = f"for two interleaved views, found {size_px[0]}x{size_px[1]}; give a larger picture"
    assert found in refusal(tmp_path / "a.png", kind)
