from dataclasses import replace

import pytest
import torch
from learn_examples import RECIPE, complaint, keep_pairs, write
from rich.console import Console

from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import VALIDATION_SEED
from stereoweave.learn.training.loop import train

QUIET = Console(quiet=True)
SHORT = replace(RECIPE, steps=2, averaged_steps=1)


@pytest.fixture
def folder(tmp_path):
    """Return a folder for runs, with pairs to train and to validate on."""
    keep_pairs(tmp_path / "pairs", RECIPE.seed, RECIPE.pairs)
    keep_pairs(tmp_path / "pairs", VALIDATION_SEED, RECIPE.validation_pairs)
    return tmp_path


def run(folder, recipe):
    """Train a recipe. Returns its last checkpoint."""
    return checkpoint.load(train(write(recipe, folder / f"{recipe.name}.toml"), folder / recipe.name, QUIET))


@pytest.mark.parametrize("micro_batch", [0, 1])
def test_only_the_trained_parts_change_their_weights_and_statistics(folder, micro_batch):
    recipe = replace(SHORT, name="parts", trained=("refinement", "weights"), micro_batch=micro_batch)
    before, after = checkpoint.make_initial(recipe, "").weights, run(folder, recipe).weights
    changed = {name for name, value in after.items() if not torch.equal(value, before[name])}
    assert {name.split(".")[0] for name in changed} == {"refinement", "weights"}
    assert "refinement.join.1.running_mean" in changed
    assert {name for name in after if name.startswith("weights.")} <= changed


def test_a_part_that_the_network_lacks_is_named_before_any_pair_is_made(tmp_path):
    recipe = replace(SHORT, name="lacking", trained=("refinement", "sharpening"))
    message = complaint(run, tmp_path, recipe)
    assert not (tmp_path / "pairs").exists()
    assert message.startswith("lacking: trained: expected parts of weave_small, which are encoder, to_match,")
    assert message.endswith("found 'sharpening'")
