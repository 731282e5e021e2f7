import math

import numpy as np
import pytest
import torch

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import DepthCurve, fit_exponent

EXPONENTS = [1.0, 1.5, 2.0, 8.0, 100.0]
CURVES = [{"max_disparity_px": 192.0}, {"max_depth_m": 15.0}]


def truths(maximum):
    """Return values over the whole range except 0, with many near both ends."""
    near_zero = np.geomspace(1e-7, 0.5, 500)
    return maximum * np.concatenate([near_zero, 1 - near_zero, [1.0]])


def test_the_code_of_a_disparity_is_its_share_of_the_maximum_raised_to_p():
    curve = DepthCurve(max_disparity_px=200.0)  # p = 1.5
    np.testing.assert_allclose(curve.encode(np.array([[0.0, 8.0, 50.0, 200.0]])), [[0, 0.008, 0.125, 1]])


@pytest.mark.parametrize("values", [50.0, [0.5], None])
@pytest.mark.parametrize("call", ["encode", "encode_estimate", "decode", "check"])
def test_what_is_no_array_is_refused(values, call):
    with pytest.raises(StereoweaveError, match="^expected an array or a tensor, found "):
        getattr(DepthCurve(max_disparity_px=200.0), call)(values)


def test_the_code_of_depth_is_large_where_it_is_near():
    curve = DepthCurve(max_depth_m=15.0, exponent=2.0)
    np.testing.assert_allclose(curve.encode(np.array([[15.0, 7.5, 3.0]])), [[0, 0.25, 0.64]], rtol=1e-12)


def test_decoding_gives_the_unit_back():
    code = np.array([0.0, 0.125, 1.0])
    np.testing.assert_allclose(DepthCurve(max_disparity_px=200.0).decode(code), [0, 50, 200])
    np.testing.assert_allclose(DepthCurve(max_depth_m=16.0).decode(code), [16, 12, 0])


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("curve", CURVES)
def test_decoding_a_code_gives_back_what_was_encoded(curve, exponent):
    curve = DepthCurve(**curve, exponent=exponent)
    maximum = curve.max_disparity_px or curve.max_depth_m
    values = truths(maximum)
    np.testing.assert_allclose(curve.decode(curve.encode(values)), values, rtol=0, atol=1e-12 * maximum)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_encoding_what_was_decoded_gives_back_every_code(exponent):
    curve = DepthCurve(max_disparity_px=192.0, exponent=exponent)
    code = np.concatenate([[0.0], np.geomspace(1e-9, 1, 1000)])
    np.testing.assert_allclose(curve.encode(curve.decode(code)), code, rtol=1e-10)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_the_straight_line_at_the_far_end_deviates_from_the_paper_by_less_than_1e_5(exponent):
    curve = DepthCurve(max_disparity_px=1.0, exponent=exponent)
    share = truths(1.0)
    paper = share**exponent
    code = curve.encode(share)
    assert abs(code - paper).max() < 1e-5
    np.testing.assert_allclose(code[paper >= 1.001e-5], paper[paper >= 1.001e-5], rtol=1e-10)


def test_for_the_papers_exponent_the_code_is_off_by_four_27ths_of_1e_5_at_most():
    # t - t^1.5, in shares t of the straight line's end, is greatest at t = 4/9: 4/9 - 8/27.
    at = 4 / 9 * 1e-5 ** (2 / 3)
    code = DepthCurve(max_disparity_px=1.0).encode(np.array([at]))
    assert code[0] - at**1.5 == pytest.approx(4 / 27 * 1e-5, rel=1e-6)


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("curve", CURVES)
def test_decoding_is_finite_in_value_and_gradient_at_both_ends(curve, exponent):
    code = torch.tensor([0.0, 1e-40, 1e-5, 1.0], requires_grad=True)
    curve = DepthCurve(**curve, exponent=exponent)
    values = curve.decode(code)
    values.sum().backward()
    maximum = curve.max_disparity_px or curve.max_depth_m
    assert values.isfinite().all()
    assert (code.grad.abs() <= 1.001e5 * maximum).all()
    assert (code.grad != 0).all()


@pytest.mark.parametrize("curve", CURVES)
def test_the_gradients_are_those_of_the_values(curve):
    curve = DepthCurve(**curve, exponent=1.5)
    code = torch.tensor([1e-6, 0.2, 0.5, 0.999], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(curve.decode, code, eps=1e-9, atol=1e-3)
    values = curve.decode(code.detach()).requires_grad_()
    assert torch.autograd.gradcheck(curve.encode, values, eps=1e-9, atol=1e-3)


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_and_tensors_get_the_same_in_their_own_precision(curve, dtype):
    curve = DepthCurve(**curve)
    values = np.array([[[[np.nan, 0.3, 7.0, 15.0]]]], dtype)
    code = curve.encode(values)
    decoded = curve.decode(code)
    assert code.dtype == decoded.dtype == dtype
    assert np.isnan(code).tolist() == np.isnan(decoded).tolist() == [[[[True, False, False, False]]]]
    tensor_code = curve.encode(torch.from_numpy(values))
    np.testing.assert_allclose(tensor_code.numpy(), code, rtol=1e-6)
    np.testing.assert_allclose(curve.decode(tensor_code).numpy(), decoded, rtol=1e-6)
    assert tensor_code.dtype == torch.from_numpy(values).dtype


def test_an_estimate_may_leave_the_range_along_the_curve():
    near = DepthCurve(max_disparity_px=100.0).encode_estimate(np.array([25.0, 100.0, 400.0]))
    np.testing.assert_allclose(near, [0.125, 1, 8])
    far = DepthCurve(max_depth_m=10.0).encode_estimate(torch.tensor([7.5, 20.0]))
    assert far.tolist() == [pytest.approx(0.125), pytest.approx(-(1e-5 ** (1 / 3)))]  # slope u0^(p - 1)


def test_a_maximum_that_float32_cannot_hold_is_still_within_the_range():
    for maximum in (192.3, 0.1, 1 / 3):
        assert DepthCurve(max_disparity_px=maximum).encode(np.array([maximum], np.float32)) == 1
        assert DepthCurve(max_depth_m=maximum).encode(torch.tensor([maximum])) == 0


@pytest.mark.parametrize(
    ("curve", "value", "message"),
    [
        ({"max_depth_m": 15.0}, 0.0, r"depth: expected more than 0 and at most 15.0 m, .* found 0.0;"),
        ({"max_depth_m": 15.0}, 15.5, r"at most 15.0 m, .* found 15.5;"),
        ({"max_depth_m": 15.0}, math.inf, r"at most 15.0 m, .* found inf;"),
        ({"max_disparity_px": 192.0}, -0.5, r"disparity: expected 0 to 192.0 px, .* found -0.5;"),
        ({"max_disparity_px": 192.0}, 192.5, r"0 to 192.0 px, .* found 192.5;"),
        ({"max_disparity_px": 192.0}, -math.inf, r"0 to 192.0 px, .* found -inf;"),
    ],
)
@pytest.mark.parametrize("kind", [np.array, lambda values: torch.tensor(values, requires_grad=True)])
def test_a_value_out_of_range_is_refused_with_the_range_and_the_value(curve, value, message, kind):
    with pytest.raises(StereoweaveError, match=message) as refusal:
        DepthCurve(**curve).encode(kind([[5.0, math.nan, value]]))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("exponent", [0.99, 0.0, -1.0, math.nan, math.inf])
def test_an_exponent_below_one_is_refused(exponent):
    with pytest.raises(StereoweaveError, match=f"exponent must be finite and at least 1, got {exponent}"):
        DepthCurve(max_depth_m=15.0, exponent=exponent)


@pytest.mark.parametrize("name", ["max_disparity_px", "max_depth_m"])
@pytest.mark.parametrize("maximum", [0.0, -1.0, math.nan, math.inf])
def test_a_maximum_must_be_positive_and_finite(name, maximum):
    with pytest.raises(StereoweaveError, match=f"{name} must be positive and finite, got {maximum}"):
        DepthCurve(**{name: maximum})


@pytest.mark.parametrize("maxima", [{}, {"max_disparity_px": 192.0, "max_depth_m": 15.0}])
def test_exactly_one_maximum_must_be_given(maxima):
    with pytest.raises(StereoweaveError, match="exactly one of max_disparity_px and max_depth_m"):
        DepthCurve(**maxima)


@pytest.mark.parametrize("exponent", [1.25, 2.0, 3.7])
@pytest.mark.parametrize("bins", [2, 10, 256])
def test_pixels_distributed_as_u_to_the_p_give_that_p(exponent, bins):
    histogram = np.diff(np.linspace(0, 1, bins + 1) ** exponent)
    assert fit_exponent(histogram) == pytest.approx(exponent, abs=1e-3)


def test_counts_give_the_same_fit_as_shares():
    # Ten bins hold 1, 3, 5, ..., 19 of 100 pixels: the first k bins hold k^2, so the distribution is u^2.
    assert fit_exponent(np.arange(1, 20, 2)) == pytest.approx(2, abs=1e-3)


def test_the_best_fit_to_a_histogram_that_is_not_a_power():
    # Edges 1/3 and 2/3, cumulative shares 0.3 and 0.3: the least squares of all exponents, tried one by one.
    exponents = np.arange(1, 8, 1e-4)
    errors = ((1 / 3) ** exponents - 0.3) ** 2 + ((2 / 3) ** exponents - 0.3) ** 2
    assert fit_exponent(np.array([3, 0, 7])) == pytest.approx(exponents[errors.argmin()], abs=1e-3)


@pytest.mark.parametrize("histogram", [[5, 0, 0, 0], [9, 3, 1, 0], [1, 1, 1, 1]])
def test_a_mostly_far_or_uniform_set_gets_exponent_one(histogram):
    assert fit_exponent(np.array(histogram)) == 1


def test_a_set_that_is_all_near_gets_the_largest_exponent():
    assert fit_exponent(np.array([0, 0, 0, 5])) == 8


@pytest.mark.parametrize(
    ("histogram", "found"),
    [
        ([], "got 0 counts, 0 of them negative"),
        ([3], "got 1 counts, "),
        ([0, 0], "with the sum 0"),
        ([2, -1], "got 2 counts, 1 of them negative"),
        ([1.0, np.nan], "with the sum nan"),
        ([1.0, np.inf], "with the sum inf"),
    ],
)
def test_an_empty_histogram_is_refused(histogram, found):
    with pytest.raises(StereoweaveError, match=found):
        fit_exponent(np.array(histogram))
