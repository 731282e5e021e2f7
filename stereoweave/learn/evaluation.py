"""Scores of trained networks on their held-out pairs, for `stereoweave bench networks`."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console

from stereoweave.bench.projected_views import (
    DisparityMethod,
    ProjectionRow,
    score_projection,
    score_projections,
)
from stereoweave.errors import StereoweaveError
from stereoweave.learn import checkpoint
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.data.batches import collate, read_known
from stereoweave.learn.data.sources import PairSource, cache_pairs, open_sources
from stereoweave.learn.devices import choose_device
from stereoweave.learn.mc_cnn_matcher import match_sample
from stereoweave.learn.models import CodeNetwork
from stereoweave.learn.models.layers import predict_any_size
from stereoweave.learn.models.mc_cnn import MCCNN
from stereoweave.learn.recipe import COLLAGE, Recipe
from stereoweave.learn.training.objective import CodeObjective
from stereoweave.stereo import Sample

MEDIAN = "median"
# The median is taken over about 400 pairs, in every 8th row and column.
_MEDIAN_PAIRS, _MEDIAN_STRIDE = 400, 8


def evaluate(runs: Sequence[Path], folder: Path, console: Console) -> list[ProjectionRow]:
    """Score each run on all its held-out pairs, and baselines on the same pairs.

    The baselines come first: ground truth, no warping, SGBM and "median". The last baseline predicts the
    median disparity of the training pairs everywhere, like a network that ignores the images.

    Args:
        runs: Run folders of `stereoweave train`, or checkpoints, all with the same held-out pairs.
        folder: Cache folder of collage pairs; missing pairs are made.
        console: Console that shows progress while pairs are made.

    Raises:
        StereoweaveError: If the runs have different held-out pairs, or two rows would have the same name.
    """
    networks = load_runs(runs)
    recipe = _find_common_recipe(networks)
    methods = {name: make_method(one) for name, one in networks.items()}
    return score_with_baselines(recipe, methods, folder, console)


def score_with_baselines(
    recipe: Recipe, methods: Mapping[str, DisparityMethod], folder: Path, console: Console
) -> list[ProjectionRow]:
    """Score baselines, then methods, on all of a recipe's held-out pairs; see `evaluate`."""
    training, held_out = (cache_pairs(pairs, console) for pairs in open_sources(recipe, folder, whole=True))
    methods = {MEDIAN: make_median_method(training), **methods}
    return score_projections(methods, _read_all(held_out), _find_depth_limit(recipe))


def score_run(trained: Checkpoint, name: str, folder: Path) -> ProjectionRow:
    """Score a checkpoint on all its held-out pairs, without baselines.

    Args:
        trained: The checkpoint.
        name: Method of the row.
        folder: Cache folder of collage pairs, which must all exist.
    """
    _, held_out = open_sources(trained.recipe, folder, whole=True)
    limit_m = _find_depth_limit(trained.recipe)
    return score_projection(name, make_method(trained), _read_all(held_out), limit_m)


def _read_all(pairs: PairSource) -> Iterator[Sample]:
    return (read_known(pairs, index) for index in range(pairs.count))


def _find_depth_limit(recipe: Recipe) -> float | None:
    return recipe.max_depth_m if recipe.target == "depth" else None


def load_runs(runs: Sequence[Path], taken: Sequence[str] = (MEDIAN,)) -> dict[str, Checkpoint]:
    """Return the last checkpoint of each run, by the run's name.

    Args:
        runs: Run folders of `stereoweave train`, or checkpoints.
        taken: Names of other rows, which no run may have.

    Raises:
        StereoweaveError: Two rows would have the same name.
    """
    names = [run.name if run.is_dir() else run.stem for run in runs]
    _check_names(names, taken)
    files = [run / "last.pt" if run.is_dir() else run for run in runs]
    return {name: checkpoint.load(file) for name, file in zip(names, files, strict=True)}


def make_method(trained: Checkpoint) -> DisparityMethod:
    """Wrap a checkpoint's averaged network as a function from a sample to the left view's disparity in px.

    The network runs on a GPU if there is one.
    """
    device = choose_device()
    network = trained.build_averaged().to(device)
    if isinstance(network, MCCNN):
        return partial(match_sample, network, int(trained.recipe.max_disparity_px))

    def match(sample: Sample) -> Float[np.ndarray, "h w"]:
        batch = {name: values.to(device) for name, values in collate([sample]).items()}
        # In float32: by default, convolutions on a GPU round to TF32.
        with torch.no_grad(), torch.backends.cudnn.flags(allow_tf32=False):
            views = batch["left"], batch["right"]
            if isinstance(network, CodeNetwork):
                return objective.disparity_px(network(*views), batch)[0, 0].cpu().numpy()
            return predict_any_size(network, *views)[0][0, 0].cpu().numpy()

    if isinstance(network, CodeNetwork):
        objective = CodeObjective(trained.recipe, network)
    return match


def make_median_method(training: PairSource) -> DisparityMethod:
    """Return a method that predicts the median disparity of the training pairs at every pixel."""
    some = range(0, training.count, max(1, training.count // _MEDIAN_PAIRS))
    values_px = [
        read_known(training, i).disparity_px[::_MEDIAN_STRIDE, ::_MEDIAN_STRIDE].ravel() for i in some
    ]
    median_px = np.nanmedian(np.concatenate(values_px))
    return lambda sample: np.full_like(sample.disparity_px, median_px)


def _check_names(names: Sequence[str], taken: Sequence[str]) -> None:
    rows = [*taken, *names]
    if twice := [name for name in names if rows.count(name) > 1]:
        others = " and ".join(map(repr, taken))
        raise StereoweaveError(
            f"{twice[0]}: expected a unique name other than {others}, found a duplicate; rename the run"
        )


def _find_common_recipe(networks: dict[str, Checkpoint]) -> Recipe:
    """Return the recipe of the first run that predicts depth, else of the first run.

    Raises:
        StereoweaveError: The runs have different held-out pairs, or different limits of depth.
    """
    pairs = {name: identify_held_out(one.recipe) for name, one in networks.items()}
    first, *others = pairs
    for name in others:
        if pairs[name] != pairs[first]:
            raise StereoweaveError(
                f"{name}: expected the held-out pairs of {first}, {pairs[first]}, found {pairs[name]}; "
                "score this run separately"
            )
    recipes = [one.recipe for one in networks.values()]
    limits_m = {limit_m for recipe in recipes if (limit_m := _find_depth_limit(recipe))}
    if len(limits_m) > 1:
        raise StereoweaveError(
            f"runs: expected one max_depth_m, found {' and '.join(map(str, sorted(limits_m)))}; "
            "score them separately"
        )
    return next((recipe for recipe in recipes if _find_depth_limit(recipe)), recipes[0])


def identify_held_out(recipe: Recipe) -> tuple[object, ...]:
    """Return the settings that determine a recipe's held-out pairs; equal settings give equal pairs."""
    if recipe.dataset == COLLAGE:
        return COLLAGE, recipe.pair_size, recipe.validation_pairs
    return recipe.dataset, recipe.root, recipe.split, recipe.leave_out
