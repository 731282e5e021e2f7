import subprocess
import sys

import numpy as np
import pytest

from stereoweave.synth import patterns
from stereoweave.synth.patterns import NATURAL, PERIODIC, PHOTOGRAPHS, SIDE, bank, power_noise, procedural


def test_the_bank_holds_textures_of_one_size_and_is_built_once():
    assert bank() is bank()
    for texture in bank().natural + bank().periodic:
        assert texture.shape == (SIDE, SIDE, 3)
        assert texture.dtype == np.uint8


def test_about_half_of_the_textures_are_crops_of_photographs():
    total = len(bank().natural) + len(bank().periodic)
    assert 0.4 < patterns.PHOTOGRAPH_CROPS / total < 0.6


def test_every_texture_shows_something():
    assert min(texture.std() for texture in bank().natural + bank().periodic) > 1


def test_a_texture_depends_on_its_number_alone():
    alone = procedural(NATURAL, 40)
    np.testing.assert_array_equal(alone, bank().natural[patterns.PHOTOGRAPH_CROPS + 40])


@pytest.mark.parametrize("kinds", [NATURAL, PERIODIC])
def test_two_textures_of_one_kind_differ(kinds):
    for k in range(len(kinds)):
        assert np.abs(procedural(kinds, k).astype(int) - procedural(kinds, k + len(kinds))).mean() > 1


def test_test_pairs_and_faces_are_not_among_the_photographs():
    assert not PHOTOGRAPHS.keys() & {"stereo_motorcycle", "lfw_subset"}


def test_noise_has_the_spectrum_that_was_asked_for():
    noise = power_noise(np.random.default_rng(0), 1.0)
    amplitude = np.abs(np.fft.fft2(noise))
    # Amplitude ~ 1 / frequency: four times the frequency, a quarter of the amplitude.
    low = np.sqrt((amplitude[10, -10:] ** 2).mean() + (amplitude[10, 1:11] ** 2).mean())
    high = np.sqrt((amplitude[40, -40:] ** 2).mean() + (amplitude[40, 1:41] ** 2).mean())
    assert low / high == pytest.approx(4, rel=0.25)
    assert noise.mean() == pytest.approx(0, abs=1e-5)
    assert noise.std() == pytest.approx(1, abs=1e-5)


def test_light_maps_never_darken_to_black_nor_blind():
    for light in bank().lights:
        assert light.dtype == np.float32
        assert 0.2 < light.min() <= light.max() < 1.7


def test_importing_the_patterns_does_not_import_scikit_image():
    code = "import sys, stereoweave.synth.patterns; assert 'skimage' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
