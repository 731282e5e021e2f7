"""VR180 photos that the package writes, read by its own reader and by Pillow."""

import io

import numpy as np
import pytest
from PIL import Image
from vr180_examples import encode_jpeg

from stereoweave.io import vr180
from stereoweave.io.vr180_photos import is_vr180_name, write_vr180_photo


def eyes(rng, shape):
    """Return noise, whose JPEG needs several segments."""
    return [rng.integers(0, 256, (*shape, 3), np.uint8) for _ in range(2)]


@pytest.mark.parametrize(("shape", "width_deg"), [((256, 256), 180.0), ((128, 256), 360.0)])
def test_both_eyes_and_their_part_of_the_sphere_are_read_back(tmp_path, rng, shape, width_deg):
    path = tmp_path / "eyes.vr.jpg"
    left, right = eyes(rng, shape)
    write_vr180_photo(path, left, right, width_deg)
    with Image.open(path) as picture:
        picture.load()
        xmp = vr180.read_xmp(picture)
        assert vr180.read_panorama(path, xmp) == (width_deg, (-90.0, 90.0))
        assert vr180.read_right_eye(path, picture, xmp) == encode_jpeg(right)
        assert np.array_equal(np.asarray(picture), np.asarray(Image.open(io.BytesIO(encode_jpeg(left)))))
    assert path.stat().st_size > 2 * 65_000
    assert [file.name for file in tmp_path.iterdir()] == ["eyes.vr.jpg"]


def test_a_vr180_photo_is_known_by_its_name(tmp_path):
    assert is_vr180_name(tmp_path / "IMG_1.VR.JPG")
    assert not is_vr180_name(tmp_path / "IMG_1.jpg")
