import numpy as np
import pytest
from image_forms import IMAGE_FORMS

import stereoweave as sw
from stereoweave.bench.metrics import psnr_db
from stereoweave.errors import MatcherError
from stereoweave.io.images import read_image
from stereoweave.pictures.estimate import estimate
from stereoweave.rendering.renderer import render
from stereoweave.rendering.synthesize import synthesize


@pytest.fixture
def pair(rng):
    coarse = rng.integers(0, 256, (12, 30, 3)).repeat(8, axis=0).repeat(8, axis=1).astype(np.uint8)
    return coarse[:, :160], coarse[:, 10:170]  # 10 px of disparity everywhere


def test_synthesizing_is_estimating_and_then_rendering(pair):
    view = synthesize(*pair, position=0.3)
    expected = render(*pair, estimate(*pair, model="best"), 0.3)
    np.testing.assert_array_equal(view.image, expected.image)
    np.testing.assert_array_equal(view.drawn, expected.drawn)


@pytest.mark.parametrize("form", IMAGE_FORMS)
def test_images_in_every_form_are_rendered_like_arrays(pair, tmp_path, form):
    pictures = [IMAGE_FORMS[form](image, tmp_path / f"{side}.png") for side, image in enumerate(pair)]
    estimate = sw.estimate(*pair)
    expected = sw.render(*pair, estimate, 0.3)
    np.testing.assert_array_equal(sw.render(*pictures, estimate, 0.3).image, expected.image)


def test_a_view_is_synthesised_from_two_files(pair, tmp_path):
    files = [IMAGE_FORMS["Path"](image, tmp_path / f"{side}.png") for side, image in enumerate(pair)]
    np.testing.assert_array_equal(synthesize(*files, 0.3).image, synthesize(*pair, 0.3).image)


def test_the_caller_chooses_the_model(pair):
    with pytest.raises(MatcherError, match="no_such_model"):
        synthesize(*pair, 0.5, model="no_such_model")


def test_a_position_out_of_range_is_refused_before_a_model_is_loaded(pair):
    with pytest.raises(ValueError, match="^position: expected"):
        synthesize(*pair, 2.5, model="no_such_model")


@pytest.mark.testdata
def test_a_view_is_closer_to_a_real_picture_from_between_than_a_blend(testdata):
    scene = testdata / "stereo/views/tsukuba"
    left, right, truth = (read_image(scene / f"{name}.png") for name in ("left", "right", "view_0.5"))
    faded = np.round((left.astype(float) + right) / 2).astype(np.uint8)
    assert psnr_db(synthesize(left, right, 0.5).image, truth) > psnr_db(faded, truth) + 6


def test_render_is_still_the_function_after_synthesize_was_used(pair):
    view = sw.synthesize(*pair, position=0.5)
    again = sw.render(*pair, sw.estimate(*pair, model="best"), position=0.5)
    np.testing.assert_array_equal(again.image, view.image)
