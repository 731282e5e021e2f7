import cv2
import numpy as np
import pytest

from stereoweave.video.cuts import begins_shot, make_small_grey


def texture(rng, size_px=(128, 96)):
    width, height = size_px
    image = cv2.GaussianBlur(rng.uniform(0, 255, (height, width, 3)), (0, 0), 1.5)
    return np.clip(128 + 4 * (image - 128), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("size_px", "shape"), [((128, 96), (48, 64)), ((129, 97), (49, 65)), ((1281, 720), (180, 320))]
)
def test_cuts_are_looked_for_at_half_the_size_and_in_at_most_320_columns(rng, size_px, shape):
    assert make_small_grey(texture(rng, size_px)).shape == shape


def test_a_shot_begins_where_the_scene_changes_and_goes_on_where_it_moves(rng):
    scene, other = texture(rng, (140, 96)), texture(rng)
    before, moved = make_small_grey(scene[:, :128]), make_small_grey(scene[:, 4:132])
    assert not begins_shot(before, moved)
    assert begins_shot(before, make_small_grey(other))


def test_the_first_frame_and_one_of_another_size_begin_a_shot(rng):
    scene = texture(rng)
    assert begins_shot(None, make_small_grey(scene))
    assert begins_shot(make_small_grey(scene), make_small_grey(scene[:64]))
