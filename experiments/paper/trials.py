"""The trainings of the paper's experiment: for each claim recipes that differ in one thing alone."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from experiments.trial import Trial
from stereoweave.learn.recipe import COLLAGE, Recipe

CLAIMS = NETWORKS, NETWORKS_SHORT, ADJUSTMENT, PROJECTION, LOSS, DECODER, TRANSFER, ITERATIONS = (
    "networks",
    "networks, a quarter of the steps",
    "depth adjustment",
    "projection loss",
    "loss",
    "decoder",
    "transfer",
    "iterations",
)
PAPER = "the paper's recipe"
FITTED = "(fitted)"
SCRATCH, TUNED = "from scratch", "from the synthetic checkpoint"
# What the rivals are trained with: the losses of their own papers, without this paper's two contributions.
OWN: dict[str, dict[str, Any]] = {
    "densemapnet": {"exponent": 1.0, "alpha_p": 0.0},
    "dispnet": {"exponent": 1.0, "alpha_p": 0.0, "loss": "l1", "learning_rate": 1e-4},
    "psmnet": {"exponent": 1.0, "alpha_p": 0.0, "loss": "smooth_l1"},
}
# PSMNet costs 59 times as many multiply-adds as the paper's network: it is compared after fewer steps.
SHORT = 4
FIGURE_3_STEPS = (10, 50, 250)
# The other set that a trained network is tuned on: few collages, larger, with larger disparities.
OTHER_SEED = 100
OTHER_PAIRS = 500
OTHER_SIZE = 1.5


def list_trials(base: Recipe, seeds: int, fitted_exponent: float) -> list[Trial]:
    """All trainings of the experiment, the most wanted first.

    One that serves several claims comes once for each, under the same recipe name. The transfer, to other
    collages, is for collages alone: of a dataset on disk the recipe knows no other set.

    Args:
        base: The paper's recipe, for the data at hand.
        seeds: How many of each; DispNet and PSMNet, the transfer and the iterations come once.
        fitted_exponent: p fitted to the histogram of the base's training truth.
    """
    # Else every p would be the fitted one.
    base = replace(base, fit_exponent=False)
    rivals = {rival: _rival_changes(rival) for rival in OWN}
    every = {"psmnet": rivals["psmnet"], "fast_depth": {}, **rivals}
    return [
        *_repeat(seeds, base, PROJECTION, {PAPER: {}, "without": {"alpha_p": 0.0}}),
        *_repeat(seeds, base, NETWORKS, {"fast_depth": {}, "densemapnet": rivals["densemapnet"]}),
        *_repeat(seeds, base, ADJUSTMENT, {f"p = {p:g}": {"exponent": p} for p in (1.0, 1.5, 2.0, 1.25)}),
        *_repeat(
            seeds, base, ADJUSTMENT, {f"p = {fitted_exponent:.3g} {FITTED}": {"exponent": fitted_exponent}}
        ),
        *_repeat(1, replace(base, steps=base.steps // SHORT), NETWORKS_SHORT, every),
        *_repeat(seeds, base, DECODER, {PAPER: {}, "upsampled at once, no skips": {"model": "densemapnet"}}),
        *_repeat(seeds, base, DECODER, {"step-wise, no skips": {"model": "fast_depth_without_skips"}}),
        *_repeat(seeds, base, LOSS, {"l2": {}, **{loss: {"loss": loss} for loss in _other_losses(base)}}),
        *(_list_transfer(base) if base.dataset == COLLAGE else ()),
        *_repeat(1, base, ITERATIONS, {f"{steps} steps": {"steps": steps} for steps in FIGURE_3_STEPS}),
        *_repeat(1, base, NETWORKS, {"dispnet": rivals["dispnet"]}),
    ]


def _repeat(seeds: int, base: Recipe, claim: str, settings: dict[str, dict[str, Any]]) -> Iterator[Trial]:
    for setting, changes in settings.items():
        for seed in range(base.seed, base.seed + seeds):
            yield Trial(claim=claim, setting=setting, recipe=_with_name(replace(base, seed=seed, **changes)))


def _list_transfer(base: Recipe) -> Iterator[Trial]:
    height, width = (int(OTHER_SIZE * side) for side in base.pair_size)
    other = replace(
        base,
        seed=OTHER_SEED,
        pairs=OTHER_PAIRS,
        pair_size=(height, width),
        max_disparity_px=OTHER_SIZE * base.max_disparity_px,
    )
    yield Trial(claim=TRANSFER, setting=SCRATCH, recipe=_with_name(other))
    start = f"{_with_name(base).name}/last.pt"  # below the folder of the runs
    yield Trial(claim=TRANSFER, setting=TUNED, recipe=_with_name(replace(other, start_from=start)))


def _rival_changes(model: str) -> dict[str, Any]:
    return {"model": model, **OWN[model]}


def _other_losses(base: Recipe) -> tuple[str, ...]:
    """Those the paper compared l2 with; the perceptual one needs a file that cannot be shipped."""
    return ("l1", "smooth_l1", "cross_entropy", *(("perceptual",) if base.vgg16_weights else ()))


def _with_name(recipe: Recipe) -> Recipe:
    """The recipe, named after everything in which trials differ."""
    parts = [
        recipe.model,
        recipe.loss,
        f"p{recipe.exponent:g}",
        f"projection{recipe.alpha_p:g}",
        f"steps{recipe.steps}",
        f"seed{recipe.seed}",
        *(["tuned"] if recipe.start_from else []),
    ]
    return replace(recipe, name="-".join(parts))
