"""Trained networks on the pairs that were held out from them: what `stereoweave bench networks` prints."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from stereoweave.errors import StereoweaveError
from stereoweave.learn import checkpoint
from stereoweave.learn.batches import collated, known
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.models import CodeNetwork, network_of
from stereoweave.learn.objective import CodeObjective
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.sources import Source, sources
from stereoweave.stereo import Sample
from stereoweave.view_benchmark import Method, ViewRow, score_views

MEDIAN = "median"
# Pairs, and every so many pixels of them along both sides, that a median is taken over.
_MEDIAN_PAIRS, _MEDIAN_STRIDE = 400, 8


def evaluate(runs: Sequence[Path]) -> list[ViewRow]:
    """A row per run on the pairs held out from it, after ground truth, no warping, SGBM and the median.

    "median" predicts the median disparity of the training pairs everywhere: what a network that looks at
    nothing can reach.

    Args:
        runs: Folders of `stereoweave train`, all with the same held-out pairs.

    Raises:
        StereoweaveError: The runs do not share their held-out pairs, or two rows would bear one name.
    """
    _check_names([run.name for run in runs])
    kept = {run.name: checkpoint.load(run / "last.pt") for run in runs}
    training, held_out = sources(_common(kept), runs[0].parent / "pairs")
    methods = {MEDIAN: median_method(training), **{name: method_of(one) for name, one in kept.items()}}
    return score_views(methods, (known(held_out, index) for index in range(held_out.count)))


def method_of(kept: Checkpoint) -> Method:
    """The averaged network of a checkpoint as a function from a sample to its left view's disparity in px."""
    network = network_of(kept.recipe)
    network.load_state_dict(kept.averaged)
    network.eval()

    def match(sample: Sample) -> Float[np.ndarray, "h w"]:
        batch = collated([sample])
        with torch.no_grad():
            output = network(batch["left"], batch["right"])
            if isinstance(network, CodeNetwork):
                return objective.disparity_px(output, batch)[0, 0].numpy()
            return output[0][0, 0].numpy()

    if isinstance(network, CodeNetwork):
        objective = CodeObjective(kept.recipe, network)
    return match


def median_method(training: Source) -> Method:
    """The median disparity of the training pairs, for every pixel of any sample."""
    some = range(0, training.count, max(1, training.count // _MEDIAN_PAIRS))
    values_px = [known(training, i).disparity_px[::_MEDIAN_STRIDE, ::_MEDIAN_STRIDE].ravel() for i in some]
    median_px = np.nanmedian(np.concatenate(values_px))
    return lambda sample: np.full_like(sample.disparity_px, median_px)


def _check_names(names: Sequence[str]) -> None:
    rows = [MEDIAN, *names]
    if twice := [name for name in names if rows.count(name) > 1]:
        raise StereoweaveError(
            f"{twice[0]}: expected run folders of different names, none of them {MEDIAN!r}; rename it"
        )


def _common(kept: dict[str, Checkpoint]) -> Recipe:
    """The recipe of the first run, whose held-out pairs the others have to share."""
    pairs = {name: held_out_of(one.recipe) for name, one in kept.items()}
    first, *others = pairs
    for name in others:
        if pairs[name] != pairs[first]:
            raise StereoweaveError(
                f"{name}: expected the pairs of {first}, {pairs[first]}, found {pairs[name]}; score it apart"
            )
    return kept[first].recipe


def held_out_of(recipe: Recipe) -> tuple[object, ...]:
    """What the recipe's held-out pairs depend on: runs that agree in it are scored on the same ones."""
    return recipe.dataset, recipe.root, recipe.split, recipe.pair_size, recipe.validation_pairs
