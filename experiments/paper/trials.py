"""Training runs of the paper's experiment: for each claim, recipes that differ in one respect only."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any

from experiments.trial import Trial
from stereoweave.learn.recipe import COLLAGE, Recipe

CLAIMS = NETWORKS, NETWORKS_SHORT, ADJUSTMENT, PROJECTION, LOSS, DECODER, TRANSFER, ITERATIONS = (
    "networks",
    "networks, fewer steps",
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
# The rivals train with the losses of their own papers, without this paper's two contributions.
RIVAL_SETTINGS: dict[str, dict[str, Any]] = {
    "densemapnet": {"exponent": 1.0, "alpha_p": 0.0},
    "dispnet": {"exponent": 1.0, "alpha_p": 0.0, "loss": "l1", "learning_rate": 1e-4},
    "psmnet": {"exponent": 1.0, "alpha_p": 0.0, "loss": "smooth_l1"},
    "scvnet": {"exponent": 1.0, "alpha_p": 0.0, "loss": "l1"},
    "ganet_11": {"exponent": 1.0, "alpha_p": 0.0, "loss": "smooth_l1"},
}
# PSMNet takes 59 times the multiply-adds of the paper's network, and SCV-Net and GA-Net are as slow, so they
# are compared with it after fewer steps: a quarter, unless the extent has another number.
SLOW_SHARE = 4
FIGURE_3_STEPS = (10, 50, 250)
# The target set of the transfer: fewer and larger collages with larger disparities.
OTHER_SEED = 100
OTHER_PAIRS = 500
OTHER_SIZE = 1.5


@dataclass(frozen=True, kw_only=True)
class Extent:
    """How much of the experiment is run.

    Attributes:
        seeds: Number of times that each setting is trained, except for the networks after fewer steps,
            DispNet, the transfer and the iterations, which are trained once.
        slow_steps: Number of steps of the slow networks, and of those compared with them; None for a quarter
            of the base's.
        claims: Names in CLAIMS.
    """

    seeds: int = 3
    slow_steps: int | None = None
    claims: Collection[str] = CLAIMS


def list_trials(base: Recipe, extent: Extent, fitted_exponent: float) -> list[Trial]:
    """List the training runs of the experiment, the most important first.

    A run that serves several claims is listed once for each, with the same recipe name. The transfer to
    another set needs collages, because a recipe names only one dataset on disk.

    Args:
        base: The paper's recipe for the data at hand.
        extent: Which claims are tested, and how often.
        fitted_exponent: The exponent p fitted to the histogram of the ground truth that the base trains on.
    """
    # Otherwise every training would replace its exponent p by the fitted one.
    base, seeds = replace(base, fit_exponent=False), extent.seeds
    rivals = {rival: _rival_changes(rival) for rival in RIVAL_SETTINGS}
    every = {"psmnet": rivals["psmnet"], "fast_depth": {}, **rivals}
    trials = [
        *_repeat(seeds, base, PROJECTION, _projection_settings(base)),
        *_repeat(seeds, base, NETWORKS, {"fast_depth": {}, "densemapnet": rivals["densemapnet"]}),
        *_repeat(seeds, base, ADJUSTMENT, {f"p = {p:g}": {"exponent": p} for p in (1.0, 1.5, 2.0, 1.25)}),
        *_repeat(
            seeds, base, ADJUSTMENT, {f"p = {fitted_exponent:.3g} {FITTED}": {"exponent": fitted_exponent}}
        ),
        *_repeat(1, _shorten(base, extent.slow_steps or base.steps // SLOW_SHARE), NETWORKS_SHORT, every),
        *_repeat(seeds, base, DECODER, {PAPER: {}, "upsampled at once, no skips": {"model": "densemapnet"}}),
        *_repeat(seeds, base, DECODER, {"step-wise, no skips": {"model": "fast_depth_without_skips"}}),
        *_repeat(seeds, base, LOSS, {"l2": {}, **{loss: {"loss": loss} for loss in _other_losses(base)}}),
        *(_list_transfer(base) if base.dataset == COLLAGE else ()),
        *_list_iterations(base),
        *_repeat(1, base, NETWORKS, {"dispnet": rivals["dispnet"]}),
    ]
    return [trial for trial in trials if trial.claim in extent.claims]


def _projection_settings(base: Recipe) -> dict[str, dict[str, Any]]:
    settings: dict[str, dict[str, Any]] = {PAPER: {}, "without": {"alpha_p": 0.0}}
    if base.target == "depth":
        # Equation 5 read in metres: the loss of a code is that of a depth divided by the square of its range.
        settings["depth in metres"] = {"alpha_p": base.alpha_p / base.max_depth_m**2}
    return settings


def _shorten(base: Recipe, steps: int) -> Recipe:
    """Return the recipe with fewer steps, of which the learning rate falls over the same share."""
    return replace(base, steps=steps, cool_down_steps=base.cool_down_steps * steps // base.steps)


def _repeat(seeds: int, base: Recipe, claim: str, settings: dict[str, dict[str, Any]]) -> Iterator[Trial]:
    for setting, changes in settings.items():
        for seed in range(base.seed, base.seed + seeds):
            yield Trial(claim=claim, setting=setting, recipe=_with_name(replace(base, seed=seed, **changes)))


def _list_iterations(base: Recipe) -> Iterator[Trial]:
    """Yield the first steps of the base, whose learning rate does not fall yet."""
    # The number of steps alone is the name of a whole training, with its decay.
    suffix = "-begun" if base.cool_down_steps else ""
    settings = {f"{steps} steps": {"steps": steps, "cool_down_steps": 0} for steps in FIGURE_3_STEPS}
    for trial in _repeat(1, base, ITERATIONS, settings):
        yield replace(trial, recipe=replace(trial.recipe, name=trial.recipe.name + suffix))


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
    start = f"{_with_name(base).name}/last.pt"  # relative to the folder of the runs
    yield Trial(claim=TRANSFER, setting=TUNED, recipe=_with_name(replace(other, start_from=start)))


def _rival_changes(model: str) -> dict[str, Any]:
    return {"model": model, **RIVAL_SETTINGS[model]}


def _other_losses(base: Recipe) -> tuple[str, ...]:
    """Return the losses that the paper compares with l2; perceptual only if its weights are given."""
    return ("l1", "smooth_l1", "cross_entropy", *(("perceptual",) if base.vgg16_weights else ()))


def _with_name(recipe: Recipe) -> Recipe:
    """Return the recipe with a name that spells out everything in which trials differ."""
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
