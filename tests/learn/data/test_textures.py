import subprocess
import sys

import numpy as np
import pytest

from stereoweave.learn.data.textures import (
    LIGHT_MAPS,
    NATURAL,
    NATURAL_TEXTURES,
    PERIODIC,
    PERIODIC_TEXTURES,
    PHOTOGRAPH_CROPS,
    PHOTOGRAPHS,
    SIDE,
    crop_photograph,
    draw_power_noise,
    make_light_map,
    make_natural,
    make_periodic,
    make_procedural,
)


@pytest.fixture(scope="module")
def textures() -> list[np.ndarray]:
    """Return all textures, the natural ones first."""
    return [make_natural(k) for k in range(NATURAL_TEXTURES)] + [
        make_periodic(k) for k in range(PERIODIC_TEXTURES)
    ]


def test_the_textures_have_one_size_and_are_made_once(textures):
    assert make_natural(3) is make_natural(3)
    for texture in textures:
        assert texture.shape == (SIDE, SIDE, 3)
        assert texture.dtype == np.uint8


def test_about_half_of_the_textures_are_crops_of_photographs(textures):
    assert 0.4 < PHOTOGRAPH_CROPS / len(textures) < 0.6


def test_every_texture_shows_something(textures):
    assert min(texture.std() for texture in textures) > 1


def test_a_texture_depends_on_its_number_alone(textures):
    assert len({texture.tobytes() for texture in textures}) == len(textures)
    np.testing.assert_array_equal(make_procedural(NATURAL, 40), make_natural(PHOTOGRAPH_CROPS + 40))
    np.testing.assert_array_equal(crop_photograph(40), make_natural(40))


@pytest.mark.parametrize("kinds", [NATURAL, PERIODIC])
def test_two_textures_of_one_kind_differ(kinds):
    for k in range(len(kinds)):
        assert (
            np.abs(make_procedural(kinds, k).astype(int) - make_procedural(kinds, k + len(kinds))).mean() > 1
        )


def test_test_pairs_and_faces_are_not_among_the_photographs():
    assert not PHOTOGRAPHS.keys() & {"stereo_motorcycle", "lfw_subset"}


def test_noise_has_the_requested_spectrum():
    noise = draw_power_noise(np.random.default_rng(0), 1.0)
    amplitude = np.abs(np.fft.fft2(noise))
    # Amplitude is proportional to 1 / frequency: a quarter at four times the frequency.
    low = np.sqrt((amplitude[10, -10:] ** 2).mean() + (amplitude[10, 1:11] ** 2).mean())
    high = np.sqrt((amplitude[40, -40:] ** 2).mean() + (amplitude[40, 1:41] ** 2).mean())
    assert low / high == pytest.approx(4, rel=0.25)
    assert noise.mean() == pytest.approx(0, abs=1e-5)
    assert noise.std() == pytest.approx(1, abs=1e-5)


def test_light_maps_neither_darken_to_black_nor_overexpose():
    for light in map(make_light_map, range(LIGHT_MAPS)):
        assert light.dtype == np.float32
        assert 0.2 < light.min() <= light.max() < 1.7


def test_importing_the_patterns_does_not_import_scikit_image():
    code = "import sys, stereoweave.learn.data.textures; assert 'skimage' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
