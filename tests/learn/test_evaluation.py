from dataclasses import replace

import numpy as np
import pytest
import torch
from learn_examples import (
    CAMERA,
    PAIR_SIZE,
    RECIPE,
    Listed,
    box_before_a_wall,
    checkpoint_of,
    complaint,
    keep_pairs,
    recipe_of,
)
from rich.console import Console

from stereoweave.bench.mc_cnn.steps import FAST, find_disparity
from stereoweave.bench.metrics import epe_px
from stereoweave.bench.projected_views import measure_projection, score_projections
from stereoweave.bench.projection import project_right
from stereoweave.learn import checkpoint
from stereoweave.learn.data.batches import collate
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.evaluation import (
    evaluate,
    identify_held_out,
    make_median_method,
    make_method,
    score_run,
)
from stereoweave.learn.mc_cnn_matcher import describe
from stereoweave.learn.models import build_network

QUIET = Console(quiet=True)
PAPER = recipe_of("fast_depth", max_disparity_px=32.0, exponent=2.0)


def kept_of(recipe, change=lambda network: None):
    """Return a checkpoint of a network with random weights, which `change` has modified."""
    torch.manual_seed(0)
    network = build_network(recipe)
    change(network)
    return checkpoint_of(network.eval(), recipe)


@torch.no_grad()
def answer_half(network):
    """Make the network predict the code 0.5, the sigmoid of 0, everywhere."""
    network.head.to_code.weight.zero_()
    network.head.to_code.bias.zero_()


KEPT = {
    "half": kept_of(PAPER, answer_half),
    "straight": kept_of(replace(PAPER, exponent=1.0), answer_half),
    "random": kept_of(PAPER),
    "psmnet": kept_of(recipe_of("psmnet")),
    "mc_cnn": kept_of(recipe_of("mc_cnn")),
    "weave_small": kept_of(RECIPE),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of runs and of their pairs.

    Training pairs have disparities of 6 and 14 px, held-out ones of 4 and 12 px; a quarter of each is near.
    """
    folder = tmp_path_factory.mktemp("runs")
    keep_pairs(folder / "pairs", VALIDATION_SEED, PAPER.validation_pairs)
    training = CachedPairs(folder / "pairs", PAPER.seed, PAPER.pairs, PAIR_SIZE)
    training.folder.mkdir()
    for index in range(training.count):
        pair = box_before_a_wall(np.random.default_rng(index), wall_px=6, box_px=14)
        training.keep(index, pair)
    for name, kept in KEPT.items():
        (folder / name).mkdir()
        checkpoint.save(kept, folder / name / "last.pt")
    return folder


@pytest.fixture(scope="module")
def rows(folder):
    return {row.method: row for row in evaluate([folder / name for name in KEPT], folder / "pairs", QUIET)}


def test_the_runs_follow_the_baselines(rows):
    assert list(rows) == ["ground truth", "no warping", "sgbm", "median", *KEPT]


def test_a_checkpoint_gets_the_scores_of_its_run_folder(folder, rows):
    (folder / "kept.pt").write_bytes((folder / "random" / "last.pt").read_bytes())
    *_, row = evaluate([folder / "kept.pt"], folder / "pairs", QUIET)
    assert row == replace(rows["random"], method="kept", epe_cm=row.epe_cm)


def test_a_run_scored_alone_has_the_row_that_it_has_beside_the_baselines(folder, rows):
    alone = score_run(KEPT["random"], "random", folder / "pairs")
    # Of collages, which have no camera, the error in cm is NaN.
    assert replace(alone, epe_cm=0.0) == replace(rows["random"], epe_cm=0.0)


def test_a_constant_disparity_has_the_expected_error(rows):
    assert rows["ground truth"].epe_px == 0
    assert rows["no warping"].epe_px == 0.75 * 4 + 0.25 * 12
    # The median is that of the training pairs, the wall's 6 px.
    assert rows["median"].epe_px == 0.75 * 2 + 0.25 * 6
    # The code 0.5 is half of 32 px, and 32 sqrt(0.5) px with p = 2.
    assert rows["straight"].epe_px == pytest.approx(0.75 * 12 + 0.25 * 4)
    assert rows["half"].epe_px == pytest.approx(0.75 * 18.627417 + 0.25 * 10.627417)


@torch.no_grad()
def disparity_px(name, sample):
    """Return the left view's disparity as the network gives it, without the code under test."""
    network = build_network(KEPT[name].recipe)
    network.load_state_dict(KEPT[name].averaged)
    batch = collate([sample])
    if name == "mc_cnn":
        left, right = (describe(network, view) for view in (sample.left, sample.right))
        return find_disparity(left, right, 48, FAST)
    output = network.eval()(batch["left"], batch["right"])
    match name:
        case "weave_small":
            return output[0][0, 0].numpy()
        case "psmnet":
            return output[0, 0].numpy()
    return 32 * np.sqrt(output[0, 0].numpy())


@pytest.mark.parametrize("name", ["random", "psmnet", "mc_cnn", "weave_small"])
def test_a_row_has_the_means_over_the_held_out_pairs(folder, rows, name):
    held_out = CachedPairs(folder / "pairs", VALIDATION_SEED, PAPER.validation_pairs, PAIR_SIZE)
    samples = [held_out[index] for index in range(held_out.count)]
    found_px = [disparity_px(name, sample) for sample in samples]
    errors = [epe_px(found, sample.disparity_px) for found, sample in zip(found_px, samples, strict=True)]
    views = [
        measure_projection(sample.right, project_right(sample.left, found))
        for found, sample in zip(found_px, samples, strict=True)
    ]
    assert rows[name].epe_px == pytest.approx(np.mean(errors), rel=1e-4)
    for measure in ("mae_sourced", "sourced_percent", "mae_filled", "psnr_db", "ssim"):
        mean = np.mean([getattr(view, measure) for view in views])
        assert getattr(rows[name], measure) == pytest.approx(mean, rel=1e-4)


def test_the_averaged_weights_are_scored(rng):
    kept = kept_of(PAPER, answer_half)
    other = replace(kept, weights=kept_of(PAPER).weights)
    found_px = make_method(other)(box_before_a_wall(rng))
    np.testing.assert_allclose(found_px, 32 * np.sqrt(0.5), rtol=1e-6)


def test_depth_is_converted_to_disparity_by_each_pairs_own_camera():
    # The code 0.5 is a depth of 4 m, which is 24 / 4 px for one camera and 12 / 4 - 1 px for the other.
    recipe = recipe_of("fast_depth", target="depth", max_depth_m=8.0)
    sample = replace(box_before_a_wall(np.random.default_rng(0)), camera=CAMERA)
    other = replace(sample, camera=replace(CAMERA, focal_px=60.0, doffs_px=1.0))
    match = make_method(kept_of(recipe, answer_half))
    for pair, expected_px in ((sample, 6.0), (other, 2.0)):
        np.testing.assert_allclose(match(pair), np.full(PAIR_SIZE, expected_px), rtol=1e-6)
    # The wall at 4 px and the box at 12 px are 6 m and 2 m away, for the other camera 12 / 5 m and 12 / 13 m.
    errors_m = 2.0, 0.75 * (4 - 12 / 5) + 0.25 * (4 - 12 / 13)
    *_, row = score_projections({"half": match}, [sample, other], recipe.max_depth_m)
    assert row.epe_cm == pytest.approx(100 * np.mean(errors_m), rel=1e-5)


def test_the_median_ignores_unknown_disparities(rng):
    sample = box_before_a_wall(rng, wall_px=4, box_px=12)
    unknown = np.where(sample.disparity_px == 4, np.float32("nan"), sample.disparity_px)
    match = make_median_method(Listed([replace(sample, disparity_px=unknown)]))
    np.testing.assert_array_equal(match(sample), np.full(PAIR_SIZE, 12.0))


def test_runs_with_different_held_out_pairs_are_refused(folder):
    (folder / "more").mkdir()
    checkpoint.save(kept_of(replace(PAPER, validation_pairs=3)), folder / "more" / "last.pt")
    message = complaint(evaluate, [folder / "random", folder / "more"], folder / "pairs", QUIET)
    assert message.startswith("more: expected the held-out pairs of random, (")
    assert message.endswith("; score this run separately")


def test_runs_with_different_greatest_depths_are_refused_in_any_order(tmp_path):
    runs = []
    for limit_m in (8.0, 10.0):
        recipe = recipe_of("fast_depth", target="depth", max_depth_m=limit_m)
        runs.append(tmp_path / f"to_{limit_m:g}_m.pt")
        checkpoint.save(checkpoint_of(build_network(recipe), recipe), runs[-1])
    for order in (runs, runs[::-1]):
        message = complaint(evaluate, order, tmp_path, QUIET)
        assert message == "runs: expected one max_depth_m, found 8.0 and 10.0; score them separately"


def test_held_out_frames_of_a_dataset_are_all_scored_whatever_a_recipe_validates_on():
    recipe = recipe_of("fast_depth", dataset="sintel", split="random")
    assert identify_held_out(recipe) == identify_held_out(replace(recipe, validation_pairs=7))
    assert identify_held_out(recipe) != identify_held_out(replace(recipe, split="scenes"))


@pytest.mark.parametrize("other", ["elsewhere/random", "median"])
def test_two_rows_with_the_same_name_are_refused(folder, other):
    message = complaint(evaluate, [folder / "random", folder / other], folder / "pairs", QUIET)
    assert message.startswith(f"{other.split('/')[-1]}: expected a unique name other than 'median'")
