import math

import pytest
import torch
from learn_examples import list_maps

from stereoweave.learn.models.weave import WeaveStages
from stereoweave.learn.training.losses import (
    confidence_loss,
    halve,
    level_cross_entropy,
    masked_mean,
    regression_loss,
    weave_losses,
)

NAN = math.nan
LEVELS = 4


def a_map(*values):
    """Return a map [1, 1, 1, W] of one row, with a gradient."""
    return torch.tensor(values, dtype=torch.float32).view(1, 1, 1, -1).requires_grad_()


def stages(height=8, width=16, logit=0.0):
    """Return an uninformed prediction: equal levels, 5 px everywhere, a confidence of one half."""
    maps = {
        "correlation": torch.zeros(2, LEVELS, height // 4, width // 4),
        "scores": torch.zeros(2, LEVELS, height // 4, width // 4),
        "coarse_px": torch.full((2, 1, height // 2, width // 2), 5.0),
        "disparity_px": torch.full((2, 1, height, width), 5.0),
        "confidence_logit": torch.zeros(2, 1, height, width),
        "upsampling_logits": tuple(
            torch.full((2, 36, height // scale, width // scale), logit) for scale in (4, 2)
        ),
    }
    found = WeaveStages(**maps)
    for values in list_maps(found):
        values.requires_grad_()
    return found


def flat_truth(value_px, height=8, width=16):
    return torch.full((2, 1, height, width), value_px), torch.zeros(2, 1, height, width, dtype=torch.bool)


def test_cross_entropy_shares_the_truth_between_its_two_levels():
    scores = torch.tensor([0.1, 0.2, 0.3, 0.4]).log().view(1, 4, 1, 1) + 7  # a shift changes nothing
    expected = -(0.75 * math.log(0.2) + 0.25 * math.log(0.3))
    assert level_cross_entropy(scores, a_map(1.25)).item() == pytest.approx(expected, abs=1e-6)


def test_cross_entropy_of_a_whole_level_is_that_of_the_level():
    scores = torch.tensor([0.1, 0.2, 0.3, 0.4]).log().view(1, 4, 1, 1)
    assert level_cross_entropy(scores, a_map(0.0)).item() == pytest.approx(-math.log(0.1), abs=1e-6)
    assert level_cross_entropy(scores, a_map(3.0)).item() == pytest.approx(-math.log(0.4), abs=1e-6)


def test_cross_entropy_counts_neither_unknown_levels_nor_those_out_of_reach():
    scores = torch.tensor([0.1, 0.2, 0.3, 0.4]).log().view(1, 4, 1, 1).repeat(1, 1, 1, 5)
    found = level_cross_entropy(scores, a_map(1.0, NAN, -0.5, 3.5, math.inf))
    assert found.item() == pytest.approx(-math.log(0.2), abs=1e-6)


def test_regression_is_the_absolute_error_less_a_quarter_and_square_below_half_a_pixel():
    truth_px = a_map(10.0, 10.0, 10.0, NAN)
    found = regression_loss(a_map(10.2, 11.0, 7.0, 3.0), truth_px)
    assert found.item() == pytest.approx((0.2**2 + 0.75 + 2.75) / 3, abs=1e-6)


def test_confidence_predicts_whether_the_error_is_within_one_pixel():
    logit = a_map(math.log(3), math.log(3), 0.0, 5.0)  # probabilities 3/4, 3/4, 1/2
    found = confidence_loss(logit, a_map(10.9, 12.0, 9.0, 1.0), a_map(10.0, 10.0, 10.0, NAN))
    expected = -(math.log(3 / 4) + math.log(1 / 4) + math.log(1 / 2)) / 3
    assert found.item() == pytest.approx(expected, abs=1e-6)


def test_confidence_does_not_move_the_disparity():
    disparity_px = a_map(10.9, 12.0)
    confidence_loss(a_map(0.0, 0.0), disparity_px, a_map(10.0, 10.0)).backward()
    assert disparity_px.grad is None


def test_halved_truth_is_the_mean_of_a_block_and_unknown_at_edges():
    truth_px = torch.tensor([[1.0, 1.2, 1.0, 2.5, 4.0, NAN], [1.4, 1.6, 1.0, 1.0, 4.0, 4.0]])[None, None]
    expected = torch.tensor([[[[1.3, NAN, NAN]]]])
    torch.testing.assert_close(halve(truth_px), expected, equal_nan=True)


def test_a_mean_over_nothing_is_zero_without_a_gradient():
    values = a_map(1.0, 2.0)
    mean = masked_mean(values, torch.zeros(1, 1, 1, 2, dtype=torch.bool))
    mean.backward()
    assert mean.item() == 0
    assert values.grad.tolist() == [[[[0, 0]]]]


def test_the_terms_of_an_uninformed_prediction():
    # 8 px are level 2; columns 0 to 7 have no match, but the levels are all alike. Each error is 3 px.
    terms = weave_losses(stages(), *flat_truth(8.0))
    expected = {
        "correlation": 0.5 * math.log(LEVELS),
        "scores": math.log(LEVELS),
        "coarse": 0.5 * 2.75,
        "disparity": 2.75,
        "confidence": 0.3 * math.log(2),
        "logits": 0,
    }
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(expected, abs=1e-5)


def test_upsampling_logits_beyond_8_cost_their_mean_excess():
    predicted = stages()
    coarse, fine = predicted.upsampling_logits
    with torch.no_grad():
        coarse[:, :18], coarse[:, 18:] = -28.0, 7.9
        fine[:, 0] = 80.0
    term = weave_losses(predicted, *flat_truth(5.0))["logits"]
    assert term.item() == pytest.approx(0.02 * (20 / 2 + 72 / 36))
    term.backward()
    assert coarse.grad[:, :18].lt(0).all()
    assert not coarse.grad[:, 18:].any()


def test_unknown_truth_gives_no_nan_gradient_and_does_not_count():
    predicted = stages(logit=9.0)
    truth_px, occluded = flat_truth(4.0)
    truth_px[:, :, 2:7, 3:11] = NAN
    terms = weave_losses(predicted, truth_px, occluded)
    torch.stack(list(terms.values())).sum().backward()
    for values in list_maps(predicted):
        assert values.grad.isfinite().all()
        assert values.grad.any()
    assert not predicted.disparity_px.grad[:, :, 2:7, 3:11].any()
    assert not predicted.confidence_logit.grad[:, :, 2:7, 3:11].any()


def test_truth_that_is_all_unknown_has_no_loss():
    predicted = stages()
    truth_px, occluded = flat_truth(NAN)
    total = torch.stack(list(weave_losses(predicted, truth_px, occluded).values())).sum()
    total.backward()
    assert total.item() == 0
    assert not any(values.grad.any() for values in list_maps(predicted))


def test_occluded_pixels_do_not_touch_the_correlation_term():
    predicted = stages()
    truth_px, occluded = flat_truth(0.0)
    occluded[0, 0, 5, 9] = True  # the pixel for row 1, column 2 at a quarter of the resolution
    terms = weave_losses(predicted, truth_px, occluded)
    torch.stack(list(terms.values())).sum().backward()
    touched = predicted.correlation.grad.abs().sum(1) > 0
    expected = torch.ones(2, 2, 4, dtype=torch.bool)
    expected[0, 1, 2] = False
    assert torch.equal(touched, expected)
    assert (predicted.scores.grad.abs().sum(1) > 0).all()


def test_pixels_whose_match_lies_outside_the_other_view_do_not_touch_the_correlation_term():
    predicted = stages()
    # Truth is looked up at columns 1, 5, 9, 13; of these, 1 and 5 are at -5 and -1 in the other view.
    weave_losses(predicted, *flat_truth(6.0))["correlation"].backward()
    touched = predicted.correlation.grad.abs().sum((0, 1, 2)) > 0
    assert touched.tolist() == [False, False, True, True]


@pytest.mark.parametrize(
    ("robust", "expected"), [(1.0, 2.5 * math.log(3.75)), (0.5, 1.25 * math.log(3.75) + 1.375)]
)
def test_a_robust_regression_is_the_logarithm_of_what_it_was(robust, expected):
    # An error of 3 px is 2.75 without the logarithm.
    assert regression_loss(a_map(7.0), a_map(10.0), robust).item() == pytest.approx(expected, abs=1e-6)


def test_truth_beyond_the_last_level_enters_no_loss():
    predicted = stages()
    # Four levels of 4 px reach 12 px.
    truth_px, occluded = flat_truth(12.5)
    terms = weave_losses(predicted, truth_px, occluded)
    assert {name: term.item() for name, term in terms.items()} == dict.fromkeys(terms, 0)
    assert weave_losses(predicted, truth_px - 0.5, occluded)["disparity"].item() == pytest.approx(6.75)


def test_truth_below_zero_counts_for_the_confidence_alone():
    terms = weave_losses(stages(), *flat_truth(-8.0))
    expected = dict.fromkeys(terms, 0) | {"confidence": 0.3 * math.log(2)}
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(expected)
