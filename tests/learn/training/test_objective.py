"""Training objectives of recipes: equation (5), worked out by hand on small pictures, and the scores."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from learn_examples import CAMERA, RECIPE, Listed, box_before_a_wall, complaint, recipe_of
from torch import nn

from stereoweave.learn.models import CodeNetwork, build_network
from stereoweave.learn.training.losses import CODE_LOSSES
from stereoweave.learn.training.objective import (
    LOSSES,
    CodeObjective,
    Objective,
    WeaveObjective,
    build_curve,
    build_objective,
    compute_target,
    fit_recipe,
)
from stereoweave.stereo import Sample

DISPARITY = recipe_of("fast_depth", max_disparity_px=4.0, exponent=2.0, alpha_p=1.0)
DEPTH = recipe_of("fast_depth", target="depth", max_depth_m=8.0, exponent=2.0, alpha_p=1.0)


class Constant(nn.Module):
    """A network that returns given constants everywhere, one for each output."""

    def __init__(self, predicts, *values, output_weights=(1.0,)):
        super().__init__()
        self.values = nn.Parameter(torch.tensor(values))
        self.predicts, self.output_weights = predicts, output_weights

    def outputs(self, left, right):
        return tuple(value.expand(len(left), 1, *left.shape[2:]) for value in self.values)

    def forward(self, left, right):
        return self.outputs(left, right)[-1]


def batch_of(disparity_px, focal_baseline_px_m=None, doffs_px=None):
    """Return a batch of one row and three columns: 0, 0.5 and 1 on the left, 0, 0 and 1 on the right."""
    truth_px = torch.tensor(disparity_px)[:, None, None]
    left = torch.tensor([0.0, 0.5, 1.0]).expand(len(truth_px), 3, 1, 3)
    right = torch.tensor([0.0, 0.0, 1.0]).expand(len(truth_px), 3, 1, 3)
    batch = {"left": left, "right": right, "disparity_px": torch.cat([truth_px, truth_px])}
    if focal_baseline_px_m is not None:
        batch["focal_baseline_px_m"] = torch.tensor(focal_baseline_px_m).view(-1, 1, 1, 1)
        batch["doffs_px"] = torch.tensor(doffs_px).view(-1, 1, 1, 1)
    return batch


def losses_of(recipe, network, batch):
    objective = build_objective(recipe, network)
    return objective.losses(objective.predict(network, batch), batch)


def assert_terms(losses, prediction, projection):
    assert losses.keys() == {"prediction", "projection"}
    assert losses["prediction"].item() == pytest.approx(prediction, rel=1e-5)
    assert losses["projection"].item() == pytest.approx(projection, rel=1e-5)


# Truth of 2 px, 4 px and unknown: u = 1/2 and 1, codes 1/4 and 1. A prediction of 1 px: u = 1/4, code 1/16;
# the errors are 3/16 and 15/16. Moved by 1 px, columns 1 and 2 exist and read 0 and 0 for 0.5 and 1.
TRUTH_PX = [[2.0, 4.0, torch.nan]]
PREDICTION = (9 / 256 + 225 / 256) / 2
PROJECTION = (0.25 + 1) / 2


@pytest.mark.parametrize(("predicts", "value"), [("code", 1 / 16), ("disparity_px", 1.0)])
def test_the_loss_is_equation_5_on_disparity_whatever_the_network_predicts(predicts, value):
    losses = losses_of(DISPARITY, Constant(predicts, value), batch_of(TRUTH_PX))
    assert_terms(losses, PREDICTION, PROJECTION)


# With f B = 4 px m and a doffs of 0, 1 px and 2 px are 4 m and 2 m: u = 1/2 and 3/4, codes 1/4 and 9/16.
# With f B = 8 px m and a doffs of 1 px, 0 px and 3 px are 8 m and 2 m: codes 0 and 9/16.
DEPTH_BATCH = [[1.0, 2.0, torch.nan], [0.0, 3.0, torch.nan]], [4.0, 8.0], [0.0, 1.0]


def test_the_loss_is_equation_5_on_depth_through_each_sample_s_own_camera():
    # The code 1/4 is 4 m: 1 px in the first sample; 8/4 - 1 = 1 px in the second.
    losses = losses_of(DEPTH, Constant("code", 1 / 4), batch_of(*DEPTH_BATCH))
    prediction = (0 + (5 / 16) ** 2 + (4 / 16) ** 2 + (5 / 16) ** 2) / 4
    assert_terms(losses, prediction, PROJECTION)


def test_pixels_are_compared_as_depth_through_each_sample_s_own_camera():
    # 1 px is 4 / 1 = 4 m in the first sample and 8 / (1 + 1) = 4 m in the second: the code 1/4.
    losses = losses_of(DEPTH, Constant("disparity_px", 1.0), batch_of(*DEPTH_BATCH))
    prediction = (0 + (5 / 16) ** 2 + (4 / 16) ** 2 + (5 / 16) ** 2) / 4
    assert_terms(losses, prediction, PROJECTION)


def test_a_depth_moves_the_pixels_of_each_sample_by_its_own_disparity():
    # 4 m is 1 px in the first sample, as above, and 8/4 - 0 = 2 px in the second: column 2 reads 0 for 1.
    losses = losses_of(
        DEPTH, Constant("code", 1 / 4), batch_of(2 * [[1.0, 2.0, torch.nan]], [4.0, 8.0], [0.0, 0.0])
    )
    assert losses["projection"].item() == pytest.approx((0.25 + 1 + 1) / 3)


@pytest.mark.parametrize(("value_px", "depth_m"), [(1.0, 4.0), (0.5, 8.0), (0.0, 16.0), (-3.0, 64.0)])
def test_pixels_beyond_the_greatest_depth_continue_along_the_tangent(value_px, depth_m):
    """A network whose first outputs are near 0 px, or behind the camera, gets a gradient to the truth."""
    # f B = 4 px m: 8 m at 0.5 px, where depth falls by 16 m per pixel.
    batch, network = batch_of([[1.0, 2.0, torch.nan]], [4.0], [0.0]), Constant("disparity_px", value_px)
    objective = CodeObjective(DEPTH, network)
    depth = objective.quantity(objective.predict(network, batch)[0], batch)
    torch.testing.assert_close(depth, torch.full((1, 1, 1, 3), depth_m))
    objective.losses(objective.predict(network, batch), batch)["prediction"].backward()
    assert network.values.grad.isfinite() and network.values.grad < 0


def test_the_terms_have_the_recipe_s_weights():
    recipe = replace(DISPARITY, alpha_z=3.0, alpha_p=0.5)
    assert_terms(
        losses_of(recipe, Constant("code", 1 / 16), batch_of(TRUTH_PX)), 3 * PREDICTION, 0.5 * PROJECTION
    )


def test_without_a_weight_there_is_no_projection():
    losses = losses_of(replace(DISPARITY, alpha_p=0.0), Constant("code", 1 / 16), batch_of(TRUTH_PX))
    assert losses.keys() == {"prediction"}


def test_outputs_are_weighted():
    # The second output is 0 px: codes of 0, errors of 1/4 and 1; nothing moves: columns read 0, 0 and 1.
    network = Constant("disparity_px", 1.0, 0.0, output_weights=(0.5, 2.0))
    losses = losses_of(DISPARITY, network, batch_of(TRUTH_PX))
    assert_terms(losses, 0.5 * PREDICTION + 2 * (1 / 16 + 1) / 2, 0.5 * PROJECTION + 2 * (0.25 / 3))


@pytest.mark.parametrize("loss", CODE_LOSSES)
def test_unknown_pixels_change_neither_value_nor_gradient(loss):
    recipe = replace(DISPARITY, loss=loss, alpha_p=0.0)
    found = []
    for truth_px in ([[2.0, 4.0, torch.nan]], [[4.0, torch.nan, 2.0]]):
        network = Constant("code", 0.2)
        value = losses_of(recipe, network, batch_of(truth_px))["prediction"]
        value.backward()
        found.append((value.item(), network.values.grad.item()))
    assert found[0] == pytest.approx(found[1])
    assert np.isfinite(found).all() and found[0][1] != 0


def test_smooth_l1_switches_at_one_pixel():
    recipe = replace(DISPARITY, loss="smooth_l1", exponent=1.0, alpha_p=0.0)
    # Errors of 1 px and 3 px of 4 px; a corner at 1/4 takes half of that off.
    losses = losses_of(recipe, Constant("disparity_px", 1.0), batch_of(TRUTH_PX))
    assert losses["prediction"].item() == pytest.approx(((1 / 4 - 1 / 8) + (3 / 4 - 1 / 8)) / 2)


def test_with_psmnet_s_settings_the_loss_is_its_own_in_units_of_the_range():
    recipe = replace(DISPARITY, loss="smooth_l1", exponent=1.0, alpha_p=0.0)
    found_px, truth_px = torch.tensor([0.3, 3.9]), torch.tensor([2.0, 4.0, torch.nan])
    network = Constant("disparity_px", *found_px.tolist(), output_weights=(0.5, 0.7))
    published = sum(
        weight * nn.functional.smooth_l1_loss(value.expand(2), truth_px[:2])
        for weight, value in zip((0.5, 0.7), found_px, strict=True)
    )
    losses = losses_of(recipe, network, batch_of([truth_px.tolist()]))
    assert losses["prediction"].item() == pytest.approx(published.item() / 4)


@pytest.mark.parametrize("recipe", [DISPARITY, DEPTH], ids=["disparity", "depth"])
def test_code_quantity_and_disparity_agree(recipe):
    batch = batch_of([[1.0, 2.0, 4.0]], [4.0], [-0.25])
    truth = compute_target(recipe, batch)
    code = build_curve(recipe).encode(truth)
    by_code, by_pixels = (
        CodeObjective(recipe, Constant(predicts, 0.0)) for predicts in ("code", "disparity_px")
    )
    for objective, output in ((by_code, code), (by_pixels, batch["disparity_px"][:1])):
        torch.testing.assert_close(objective.code(output, batch), code)
        torch.testing.assert_close(objective.quantity(output, batch), truth)
        # One lies in front of where the disparity of depth is held: 4 m / 3 columns.
        torch.testing.assert_close(
            objective.disparity_px(output, batch)[..., :2], batch["disparity_px"][:1, ..., :2]
        )


def test_the_greatest_depth_is_accepted_and_one_beyond_is_refused():
    # 5.4 px m / 0.9 px is 6 m, and in float32 a little more; 5.4 / 1.8 is 3 m, the code (1/2)^2.
    assert torch.tensor(5.4) / torch.tensor(0.9) > 6
    recipe = replace(DEPTH, max_depth_m=6.0)
    at_the_end = compute_target(recipe, batch_of([[0.9, 1.8, torch.nan]], [5.4], [0.0]))
    torch.testing.assert_close(build_curve(recipe).encode(at_the_end)[0, 0, 0, :2], torch.tensor([0.0, 0.25]))
    beyond = batch_of([[0.89, 1.8, torch.nan]], [5.4], [0.0])
    message = complaint(build_objective(recipe, Constant("code", 0.5)).check, beyond)
    assert message.startswith(
        "depth: expected more than 0 and at most 6.0 m, or NaN where unknown, found 6.06"
    )


def test_a_disparity_beyond_the_greatest_counts_as_unknown():
    some, known = batch_of([[2.0, 4.5, 0.0]]), batch_of([[2.0, torch.nan, 0.0]])
    losses = losses_of(DISPARITY, Constant("code", 0.5), some)
    assert losses["prediction"] == losses_of(DISPARITY, Constant("code", 0.5), known)["prediction"]


def test_a_disparity_below_0_is_refused():
    objective = build_objective(DISPARITY, Constant("code", 0.5))
    message = complaint(objective.check, batch_of([[2.0, -0.5, 0.0]]))
    assert message.startswith("disparity: expected 0 to 4.0 px, or NaN where unknown, found -0.5")


def test_fresh_collages_are_refused_for_networks_that_cannot_learn_negative_disparities():
    recipe = recipe_of("fast_depth", fresh=True)
    message = complaint(build_objective, recipe, Constant("code", 0.5))
    assert message.startswith("tiny: fresh: expected false for model = 'fast_depth', found true; ")


def test_depth_without_a_camera_is_refused():
    assert complaint(losses_of, DEPTH, Constant("code", 0.5), batch_of(TRUTH_PX)) == (
        "tiny: target = 'depth': expected pairs with a camera, found dataset = 'collage' without cameras; "
        "train on disparity"
    )


def test_each_network_has_its_objective():
    with torch.device("meta"):
        weave = build_objective(RECIPE, build_network(RECIPE))
        paper = build_objective(DISPARITY, build_network(DISPARITY))
    assert isinstance(weave, WeaveObjective) and isinstance(weave, Objective)
    assert isinstance(paper, CodeObjective) and isinstance(paper, Objective)
    assert isinstance(Constant("code", 0.5), CodeNetwork)


def test_a_loss_that_is_unknown_or_another_network_s_is_refused():
    assert LOSSES == ("weave", "l2", "l1", "smooth_l1", "cross_entropy", "perceptual", "hinge")
    paper, known = Constant("code", 0.5), "l2 or l1 or smooth_l1 or cross_entropy or perceptual"
    with torch.device("meta"):
        weave, patches = build_network(RECIPE), build_network(recipe_of("mc_cnn"))
    for recipe, network, expected in (
        (replace(DISPARITY, loss="l3"), paper, f"one of {', '.join(LOSSES)}"),
        (replace(DISPARITY, loss="weave"), paper, f"{known} for model = 'fast_depth'"),
        (replace(RECIPE, loss="l2"), weave, "weave for model = 'weave_small'"),
        (replace(DISPARITY, loss="hinge"), paper, f"{known} for model = 'fast_depth'"),
        (recipe_of("mc_cnn", loss="l2"), patches, "hinge for model = 'mc_cnn'"),
    ):
        message = complaint(build_objective, recipe, network)
        assert message == f"tiny: loss: expected {expected}, found {recipe.loss!r}"


def test_cross_entropy_is_refused_for_pixels_which_may_leave_their_range():
    recipe = replace(DISPARITY, loss="cross_entropy")
    assert complaint(build_objective, recipe, Constant("disparity_px", 2.0)) == (
        "tiny: loss = 'cross_entropy': expected a network that predicts codes, found model = "
        f"{recipe.model!r}, whose disparities may be out of range; choose another loss"
    )
    assert build_objective(recipe, Constant("code", 0.5)).recipe == recipe


def test_a_perceptual_loss_without_the_name_of_its_file_is_refused():
    recipe = replace(DISPARITY, loss="perceptual")
    message = complaint(build_objective, recipe, Constant("code", 0.5))
    assert message.startswith("tiny: vgg16_weights: expected the path of torchvision's vgg16-397923af.pth")
    assert message.endswith("found none; the file is never downloaded automatically")


def test_a_perceptual_loss_without_its_file_is_refused(tmp_path):
    file = str(tmp_path / "vgg16.pth")
    recipe = replace(DISPARITY, loss="perceptual", vgg16_weights=file)
    assert complaint(build_objective, recipe, Constant("code", 0.5)).startswith(
        f"{file}: no such file; expected "
    )


def sample_of(disparity_px, camera=CAMERA):
    """Return a sample of a grey pair with this disparity."""
    disparity_px = np.asarray(disparity_px, np.float32)
    grey, hidden = np.full((*disparity_px.shape, 3), 99, np.uint8), np.zeros(disparity_px.shape, bool)
    return Sample(
        left=grey,
        right=grey,
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        occluded=hidden,
        right_occluded=hidden,
        camera=camera,
    )


@pytest.mark.parametrize("exponent", [1.0, 2.0, 3.5])
@pytest.mark.parametrize("target", ["disparity", "depth"])
def test_an_exponent_is_fitted_to_the_truth_of_the_training_pairs(target, exponent):
    # Of the share q of all pixels u is below q^(1/p): u^p is spread evenly.
    share = (np.arange(9600) + 0.5) / 9600
    straight = (share ** (1 / exponent)).reshape(3, 40, 80)
    to_px = (lambda u: 16 * u) if target == "disparity" else (lambda u: 24 / (8 * (1 - u)))
    pairs = Listed([sample_of(to_px(u)) for u in straight])
    recipe = recipe_of(
        "fast_depth", target=target, max_disparity_px=16.0, max_depth_m=8.0, exponent=1.25, fit_exponent=True
    )
    found = fit_recipe(recipe, pairs)
    assert found.exponent == pytest.approx(exponent, rel=0.01)
    assert found == replace(recipe, exponent=found.exponent) == fit_recipe(recipe, pairs)
    kept = replace(recipe, fit_exponent=False)
    assert fit_recipe(kept, pairs) is kept


def scores_of(recipe, value_px):
    """Return the scores of a constant on two pairs: one of 4 px with a quarter at 12 px, and one of 4 px."""
    pairs = Listed(
        [replace(box_before_a_wall(np.random.default_rng(0)), camera=CAMERA), sample_of([[4.0, 4.0]])]
    )
    network = Constant("disparity_px", value_px).train()
    scores = build_objective(recipe, network).scores(network, pairs, torch.device("cpu"))
    assert not network.training
    return scores


@pytest.mark.parametrize("exponent", [1.0, 3.0])
@pytest.mark.parametrize("target", ["disparity", "depth"])
def test_scores_are_means_over_pairs_and_the_squared_error_is_that_before_the_exponent(target, exponent):
    # f B = 24 px m: 4 px and 12 px are u = 1/4 and 3/4 of 16 px, and 6 m and 2 m the same of 8 m.
    recipe = recipe_of("fast_depth", target=target, max_disparity_px=16.0, max_depth_m=8.0, exponent=exponent)
    scores = scores_of(recipe, 4.0)
    assert scores["loss"] == scores["prediction"]
    assert scores["prediction"] == pytest.approx((0.75**exponent - 0.25**exponent) ** 2 / 4 / 2, rel=1e-5)
    assert scores["squared_error"] == pytest.approx((1 / 2) ** 2 / 4 / 2, rel=1e-5)
    assert scores["epe_px"] == pytest.approx(8 / 4 / 2)
    if target == "depth":
        assert scores["depth_error_m"] == pytest.approx(4 / 4 / 2, rel=1e-5)
    else:
        assert "depth_error_m" not in scores


@pytest.mark.parametrize("exponent", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("target", ["disparity", "depth"])
def test_a_perfect_estimate_scores_0_in_everything(target, exponent):
    recipe = recipe_of("fast_depth", target=target, exponent=exponent, alpha_p=1.0)
    network = Constant("disparity_px", 4.0)
    scores = build_objective(recipe, network).scores(
        network, Listed([sample_of([[4.0] * 6])]), torch.device("cpu")
    )
    assert scores.keys() - {"depth_error_m"} == {
        "loss",
        "prediction",
        "projection",
        "squared_error",
        "epe_px",
    }
    assert scores == pytest.approx(dict.fromkeys(scores, 0.0), abs=1e-6)
