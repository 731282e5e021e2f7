"""WeaveNet's loss with settings of recipes; test_losses.py works out the loss at its defaults."""

from dataclasses import replace

import pytest
import torch
from learn_examples import RECIPE, list_maps, untrained

from stereoweave.learn.models.weave import WeaveStages
from stereoweave.learn.training.losses import regression_loss, weave_losses
from stereoweave.learn.training.objective import WeaveObjective, WeavePrediction, build_objective

LEVELS = 4


def prediction(estimate_px=5.0, level_px=4, height=16, width=32):
    """Return a prediction of one disparity everywhere, with equal levels."""
    maps = {
        "correlation": torch.zeros(2, LEVELS, height // level_px, width // level_px),
        "scores": torch.zeros(2, LEVELS, height // level_px, width // level_px),
        "coarse_px": torch.full((2, 1, height // 2, width // 2), estimate_px),
        "disparity_px": torch.full((2, 1, height, width), estimate_px),
        "confidence_logit": torch.zeros(2, 1, height, width),
        "upsampling_logits": tuple(
            torch.full((2, 36, height // scale, width // scale), 9.0) for scale in (level_px, 2)
        ),
    }
    found = WeaveStages(**maps)
    for values in list_maps(found):
        values.requires_grad_()
    return found


def batch_of(truth_px, height=16, width=32):
    torch.manual_seed(0)
    return {
        "left": torch.rand(1, 3, height, width),
        "right": torch.rand(1, 3, height, width),
        "disparity_px": torch.full((2, 1, height, width), truth_px),
        "occluded": torch.zeros(2, 1, height, width, dtype=torch.bool),
    }


def losses_of(predicted, batch, **changes):
    return WeaveObjective(replace(RECIPE, **changes)).losses(WeavePrediction(predicted), batch)


def test_a_recipe_that_says_nothing_has_the_loss_as_it_was_to_the_last_bit():
    assert (RECIPE.distribution, RECIPE.exponent, RECIPE.alpha_p) == (1, 1, 0)
    network, batch = untrained(), batch_of(7.3, 32, 64)
    with torch.no_grad():
        predicted = network.stages(batch["left"], batch["right"])
    found = build_objective(RECIPE, network).losses(WeavePrediction(predicted), batch)
    assert found == weave_losses(predicted, batch["disparity_px"], batch["occluded"])
    assert found["disparity"] == regression_loss(predicted.disparity_px, batch["disparity_px"])
    assert list(found) == ["correlation", "scores", "coarse", "disparity", "confidence", "logits"]


@pytest.mark.parametrize("weight", [0.0, 0.5])
def test_the_weight_of_the_distribution_is_that_of_both_cross_entropies_alone(weight):
    predicted, batch = prediction(), batch_of(8.0)
    whole, found = losses_of(predicted, batch), losses_of(predicted, batch, distribution=weight)
    for name, term in whole.items():
        share = weight if name in ("correlation", "scores") else 1
        assert term > 0
        assert found[name].item() == pytest.approx(share * term.item())


def test_an_exponent_compares_codes_as_pixels():
    # Of 16 px: 5 px are 25 / 16 and 8 px are 4, so that the error is 39 / 16, less a quarter.
    found = losses_of(prediction(), batch_of(8.0), exponent=2.0, max_disparity_px=16.0)
    assert found["disparity"].item() == pytest.approx(39 / 16 - 0.25)
    assert found["coarse"].item() == pytest.approx(0.5 * (39 / 16 - 0.25))
    plain = losses_of(prediction(), batch_of(8.0))
    for name in ("correlation", "scores", "confidence"):
        assert found[name].item() == pytest.approx(plain[name].item())


def test_an_exponent_has_a_gradient_below_zero_and_beyond_the_range():
    for estimate_px in (-3.0, 0.0, 300.0):
        predicted = prediction(estimate_px)
        losses_of(predicted, batch_of(8.0), exponent=1.5)["disparity"].backward()
        assert predicted.disparity_px.grad.isfinite().all()
        assert predicted.disparity_px.grad.any()


def test_the_projection_loss_is_that_of_the_final_disparity_of_the_left_view():
    predicted, batch = prediction(0.0), batch_of(8.0)
    found = losses_of(predicted, batch, alpha_p=3.0)
    expected = 3 * (batch["left"] - batch["right"]).square().mean()  # nothing moves at 0 px
    assert found["projection"].item() == pytest.approx(expected.item(), rel=1e-5)
    found["projection"].backward()
    left_gradient, right_gradient = predicted.disparity_px.grad.chunk(2)
    assert left_gradient.any()
    assert not right_gradient.any()
    assert predicted.coarse_px.grad is None


def test_levels_at_an_eighth_are_of_8_px_and_looked_up_in_the_middle_of_their_pixels():
    # At 1/8 a row of four pixels stands at columns 3, 11, 19, 27: 0, 8, 16 and 24 px are a level each.
    batch = batch_of(0.0)
    truth_px = torch.tensor([0.0, 8.0, 16.0, 24.0]).repeat_interleave(8)
    batch["disparity_px"] = truth_px.expand(2, 1, 16, 32).contiguous()
    predicted = prediction(level_px=8)
    scores = 50 * torch.eye(LEVELS)[None, :, None].expand(2, -1, 2, -1)  # level i at column i
    assert losses_of(replace(predicted, scores=scores), batch)["scores"].item() == pytest.approx(0, abs=1e-6)
    # Reversed, every column has the level of another one.
    losses = losses_of(replace(predicted, scores=scores.flip(3)), batch)
    assert losses["scores"].item() == pytest.approx(50)
