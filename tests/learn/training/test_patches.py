"""MC-CNN's training: its loss and its patches, worked out by hand, and a miniature training."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from learn_examples import Listed, box_before_a_wall, recipe_of

from stereoweave.learn.data.batches import collate
from stereoweave.learn.models.mc_cnn import MCCNN
from stereoweave.learn.training.objective import build_objective
from stereoweave.learn.training.patches import PATCHES, PatchObjective, cut_patches, hinge_loss

RECIPE = recipe_of("mc_cnn", max_disparity_px=24.0)
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def same_draws():
    torch.manual_seed(0)


class Centres(MCCNN):
    """A network whose vector of a patch is its place on a circle: the centre's level as an angle."""

    def describe_patches(self, patches):
        angle = patches[:, 0, 5, 5]
        return torch.stack([angle.cos(), angle.sin()], 1)


def batch_of(sample):
    return collate([sample])


def test_a_false_match_costs_what_it_lacks_to_be_less_similar_by_a_fifth():
    true, false = torch.tensor([0.9, 0.5, 0.3, 0.1]), torch.tensor([0.7, 0.2, 0.2, 0.4])
    # 0.2 + false - true: 0, -0.1, 0.1 and 0.5
    torch.testing.assert_close(hinge_loss(true, false), torch.tensor((0.1 + 0.5) / 4))
    assert hinge_loss(torch.empty(0), torch.empty(0)) == 0


def test_a_patch_is_centred_on_its_place_to_a_fraction_of_a_pixel():
    rows, columns = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    patches = cut_patches(
        (100 * rows + columns)[None, None], torch.tensor([7.0, 12.25]), torch.tensor([9.0, 6.0])
    )
    assert patches.shape == (2, 1, 11, 11)
    torch.testing.assert_close(patches[:, 0, 5, 5], torch.tensor([907.0, 612.25]))
    torch.testing.assert_close(patches[:, 0, 0, 10], torch.tensor([412.0, 117.25]), rtol=1e-5, atol=0)


def test_a_true_match_is_within_half_a_pixel_and_a_false_one_1_5_to_6_px_away():
    """Views whose levels rise by 1 a column, 4 px apart, before they are standardised."""
    ramp = np.repeat(np.arange(100, dtype=np.uint8)[None, :, None], 40, 0).repeat(3, 2)
    truth_px, unseen = np.full((40, 96), 4, np.float32), np.zeros((40, 96), bool)
    sample = replace(
        box_before_a_wall(np.random.default_rng(0), (40, 96)),
        left=ramp[:, :96], right=ramp[:, 4:], disparity_px=truth_px, right_disparity_px=truth_px,
        occluded=unseen, right_occluded=unseen,
    )  # fmt: skip
    true, false = PatchObjective(RECIPE).predict(Centres(), batch_of(sample))
    assert len(true) == len(false) == PATCHES
    # Neighbouring columns are this far apart; the left view is 4 px darker, which standardising takes away.
    step = 1 / np.arange(96).std()
    off_px = [np.arccos(values.numpy().astype(float).clip(-1, 1)) / step for values in (true, false)]
    shift_px = 4
    assert off_px[0].min() > shift_px - 0.51 and off_px[0].max() < shift_px + 0.51
    others_px = np.abs(off_px[1] - shift_px)
    assert (others_px > 1.49).all() and off_px[1].max() < shift_px + 6.01


def test_only_pixels_that_both_cameras_see_are_drawn(rng):
    sample = box_before_a_wall(rng)
    nothing = replace(sample, occluded=np.ones_like(sample.occluded))
    unknown = replace(sample, disparity_px=np.full_like(sample.disparity_px, np.nan))
    objective = build_objective(RECIPE, network := MCCNN())
    for one in (nothing, unknown):
        predicted = objective.predict(network, batch_of(one))
        assert [len(values) for values in predicted] == [0, 0]
        loss = objective.losses(predicted, batch_of(one))["hinge"]
        loss.backward()
        assert loss == 0
    assert [len(values) for values in objective.predict(network, collate([sample, nothing]))] == [PATCHES] * 2


def test_training_lowers_the_loss_of_pairs_that_it_has_not_seen(rng):
    objective, network = build_objective(RECIPE, MCCNN()), MCCNN()
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    unseen = collate([box_before_a_wall(np.random.default_rng(99)) for _ in range(4)])

    def measure(batch):
        return objective.losses(objective.predict(network, batch), batch)["hinge"]

    untrained = measure(unseen)
    for _ in range(25):
        loss = measure(collate([box_before_a_wall(rng) for _ in range(2)]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert measure(unseen) < 0.3 * untrained


def test_scores_are_of_the_most_similar_vectors(rng):
    """Even random vectors match noise that is the same in both views, but not what one view lacks."""
    sample = box_before_a_wall(rng, wall_px=4, box_px=12)
    scores = PatchObjective(RECIPE).scores(MCCNN(), Listed([sample]), CPU)
    assert scores.keys() == {"epe_px", "bad1_percent", "bad2_percent"}
    assert 100 * sample.occluded.mean() / 3 < scores["bad2_percent"] <= scores["bad1_percent"] < 15
