"""Strength and convergence for a screen keep the depth in its budget; values worked out by hand."""

import math

import numpy as np
import pytest

import stereoweave as sw
from stereoweave.errors import StereoweaveError
from stereoweave.rendering.comfort import SCREENS, Depth, ScreenChoice, fit_depth, measure_depth
from stereoweave.stereo import Estimate

TELEVISION = SCREENS["television"]  # 1 % in front, 2 % behind


def estimate_of(disparity_px: np.ndarray, confidence: float | np.ndarray = 1.0) -> Estimate:
    disparity_px = disparity_px.astype(np.float32)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        confidence=np.broadcast_to(np.float32(confidence), disparity_px.shape).copy(),
        occluded=np.zeros(disparity_px.shape, bool),
    )


def test_a_range_of_twice_the_budget_is_halved_and_laid_at_its_ends():
    # 1000 px wide: 10 px in front and 20 px behind; 70 - 10 = 60 px, twice 30 px.
    # At strength 0.5, the near end is 10 px in front: 0.5 * (70 - 50) = 10, and 0.5 * (50 - 10) = 20.
    fit = fit_depth(Depth(70.0, 10.0, 15.0), 1000, TELEVISION)
    assert (fit.strength, fit.convergence_px) == pytest.approx((0.5, 50.0))
    assert (fit.front_percent, fit.behind_percent) == pytest.approx((1.0, 2.0))
    assert fit.fits
    assert fit.describe() == "strength 0.50, convergence 50.0 px, depth -1.0 % to +2.0 % of the width"


def test_a_shallow_scene_is_not_exaggerated_and_its_median_is_on_the_screen():
    fit = fit_depth(Depth(16.0, 4.0, 8.0), 1000, TELEVISION)
    assert (fit.strength, fit.convergence_px, fit.fits) == (1.0, 8.0, True)
    assert (fit.front_percent, fit.behind_percent) == pytest.approx((0.8, 0.4))


def test_the_median_is_moved_behind_the_screen_as_far_as_the_budget_in_front_needs():
    # The near end is 24 px before the median, but only 10 px may be in front: the screen is at 34 - 10 px.
    fit = fit_depth(Depth(34.0, 8.0, 10.0), 1000, TELEVISION)
    assert (fit.strength, fit.convergence_px) == (1.0, 24.0)
    assert (fit.front_percent, fit.behind_percent) == pytest.approx((1.0, 1.6))


def test_a_given_convergence_is_kept_and_the_strength_fits_both_ends():
    # 40 px in front of 30 px may be 10 px; 20 px behind may be 20 px.
    fit = fit_depth(Depth(70.0, 10.0, 15.0), 1000, TELEVISION, convergence_px=30.0)
    assert (fit.strength, fit.convergence_px) == (0.25, 30.0)
    assert fit.fits


def test_too_much_at_a_given_strength_is_shared_like_the_budget():
    # 60 px: 20 px in front and 40 px behind, as 1 % to 2 %.
    fit = fit_depth(Depth(70.0, 10.0, 15.0), 1000, TELEVISION, strength=1.0)
    assert (fit.strength, fit.convergence_px, fit.fits) == (1.0, 50.0, False)
    assert (fit.front_percent, fit.behind_percent) == pytest.approx((2.0, 4.0))
    choice = ScreenChoice(name="television", strength=1.0)
    assert choice.describe(fit) == (
        "television: strength 1.00, convergence 50.0 px, depth -2.0 % to +4.0 % of the width; strength as "
        "given; comfortable would be -1.0 % to +2.0 % of the width"
    )


def test_a_strength_of_0_is_flat_at_the_median():
    fit = fit_depth(Depth(70.0, 10.0, 15.0), 1000, TELEVISION, strength=0.0)
    assert (fit.strength, fit.convergence_px, fit.front_percent, fit.behind_percent) == (0.0, 15.0, 0.0, 0.0)


@pytest.mark.parametrize("name", ["phone", "television", "headset"])
def test_no_budget_exceeds_one_degree_or_the_distance_of_the_eyes(name):
    screen = SCREENS[name]
    one_degree_m = screen.distance_m * math.tan(math.radians(1.0))
    assert screen.front_percent / 100 * screen.width_m <= one_degree_m
    assert screen.behind_percent / 100 * screen.width_m <= min(one_degree_m, 0.065)


def test_the_outermost_and_the_unsure_pixels_are_no_part_of_the_range():
    px = np.tile(np.linspace(10.0, 50.0, 100), (100, 1))
    px[:50, 0] = 500.0  # 0.6 % of the sure pixels
    confidence = np.ones((100, 100))
    px[:, 40:60], confidence[:, 40:60] = -900.0, 0.1
    near_px, far_px, _ = measure_depth(estimate_of(px, confidence))
    assert near_px == pytest.approx(50.0, abs=0.5)
    assert far_px == pytest.approx(10.2, abs=0.5)


def test_unsure_pixels_alone_show_no_range():
    assert measure_depth(estimate_of(np.ones((20, 20)), 0.2)) is None


def test_the_python_interface_gives_what_the_renderer_takes():
    px = np.tile(np.linspace(10.0, 70.0, 1000), (8, 1))
    fit = sw.fit_screen(estimate_of(px), "television")
    # Without the outer hundredths, the range is 58.8 px of the 30 px that fit.
    assert fit.strength == pytest.approx(30 / 58.8, rel=1e-3)
    assert fit.convergence_px == pytest.approx(70 - 0.6 - 10 / fit.strength, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            {"screen": "cinema"},
            "screen: expected one of phone, television, headset, light_field, found 'cinema'",
        ),
        ({"screen": "phone", "strength": -1.0}, "strength: expected 0 or more, got -1.0"),
        (
            {"screen": "phone", "convergence_px": -21.0},
            "convergence_px: expected -20 to 20 px (the picture's width), got -21.0",
        ),
    ],
)
def test_wrong_values_are_named(arguments, words):
    with pytest.raises(StereoweaveError) as raised:
        sw.fit_screen(estimate_of(np.ones((20, 20))), **arguments)
    assert str(raised.value) == words
