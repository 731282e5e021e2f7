"""Training objectives: one for WeaveNet, one for MC-CNN, and the paper's for all other networks."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from stereoweave.arguments import suggest
from stereoweave.bench import metrics
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.learn.data.batches import collate, read_known
from stereoweave.learn.data.sources import PairSource
from stereoweave.learn.models import CodeNetwork
from stereoweave.learn.models.mc_cnn import MCCNN
from stereoweave.learn.models.weave import WeaveNet, WeaveStages
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.losses import (
    CODE_LOSSES,
    projection_loss,
    regression_loss,
    smooth_l1_loss,
    weave_losses,
)
from stereoweave.learn.training.patches import PatchObjective
from stereoweave.learn.training.perceptual import PerceptualLoss
from stereoweave.learn.training.scores import validate
from stereoweave.learn.training.steadiness import predict_with_amplification
from stereoweave.learn.training.teacher import Lesson, Teacher, distillation_losses
from stereoweave.learn.training.warp import depth_to_disparity
from stereoweave.stereo import DepthCurve, Sample, fit_exponent

Batch = dict[str, Tensor]
Map = Float[Tensor, "b 1 h w"]

WEAVE, SMOOTH_L1, CROSS_ENTROPY, PERCEPTUAL = "weave", "smooth_l1", "cross_entropy", "perceptual"
HINGE = "hinge"
LOSSES = (WEAVE, *CODE_LOSSES, PERCEPTUAL, HINGE)
# Numbers of training pairs and of bins in the ground-truth histogram to which an exponent is fitted.
_FITTED_PAIRS, _FITTED_BINS = 200, 256


@runtime_checkable
class Objective(Protocol):
    """A training loss and the validation scores that go with it.

    Attributes:
        recordable: Whether a CUDA graph can record prediction and losses: they run the same operations for
            every batch, and never wait for the GPU.
    """

    recordable: bool

    def check(self, batch: Batch) -> None:
        """Raise StereoweaveError if the batch's ground truth cannot be trained on."""
        ...

    def predict(self, network: Any, batch: Batch) -> Any:
        """Return the predictions that `losses` needs, in training precision."""
        ...

    def losses(self, predicted: Any, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted loss terms by name; training minimises their sum."""
        ...

    def scores(self, network: Any, pairs: PairSource, device: torch.device) -> dict[str, float]:
        """Return mean scores over held-out pairs."""
        ...


def build_objective(recipe: Recipe, network: nn.Module) -> Objective:
    """Build a recipe's objective. Raises FormatError if the loss is unknown or does not fit the network."""
    if recipe.loss not in LOSSES:
        raise FormatError(
            f"{recipe.name}: loss: expected one of {', '.join(LOSSES)}, found {recipe.loss!r}"
            + suggest(recipe.loss, list(LOSSES))
        )
    if recipe.loss not in (fitting := _list_fitting(network)):
        raise FormatError(
            f"{recipe.name}: loss: expected {' or '.join(fitting)} for model = {recipe.model!r}, "
            f"found {recipe.loss!r}"
        )
    if isinstance(network, WeaveNet):
        return WeaveObjective(recipe, _load_teacher(recipe, network))
    _refuse_weave_settings(recipe)
    if isinstance(network, MCCNN):
        return PatchObjective(recipe)
    assert isinstance(network, CodeNetwork)
    if recipe.loss == CROSS_ENTROPY and network.predicts != "code":
        raise FormatError(
            f"{recipe.name}: loss = {recipe.loss!r}: expected a network that predicts codes, found "
            f"model = {recipe.model!r}, whose disparities may be out of range; choose another loss"
        )
    return CodeObjective(recipe, network)


def _load_teacher(recipe: Recipe, network: WeaveNet) -> Teacher | None:
    """Load a recipe's teacher, if it has one. Raises FormatError if it does not fit the network or crops."""
    if not recipe.teacher:
        return None
    teacher = Teacher(Path(recipe.teacher))
    own, others = (f"{one.levels} levels to {one.max_disparity_px} px" for one in (network, teacher.network))
    if others != own:
        raise FormatError(
            f"{recipe.name}: teacher: expected {own} as in {recipe.model}, found {others} in {recipe.teacher}"
        )
    if any(side % teacher.network.multiple_of for side in recipe.crop_size):
        raise FormatError(
            f"{recipe.name}: crop_size: expected multiples of {teacher.network.multiple_of} for "
            f"{recipe.teacher}, found {list(recipe.crop_size)}"
        )
    return teacher


def _refuse_weave_settings(recipe: Recipe) -> None:
    """Raise FormatError if a recipe of another network has a loss or pairs of WeaveNet's alone."""
    for name in ("steadiness", "teacher"):
        if value := getattr(recipe, name):
            raise FormatError(
                f"{recipe.name}: {name}: expected none for model = {recipe.model!r}, found {value!r}; "
                "only a WeaveNet has this loss"
            )
    if recipe.fresh:
        raise FormatError(
            f"{recipe.name}: fresh: expected false for model = {recipe.model!r}, found true; some fresh "
            "collages have disparities below 0, from which only a WeaveNet can learn"
        )


def _list_fitting(network: nn.Module) -> tuple[str, ...]:
    """List the losses that can train a network."""
    if isinstance(network, WeaveNet):
        return (WEAVE,)
    return (HINGE,) if isinstance(network, MCCNN) else (*CODE_LOSSES, PERCEPTUAL)


class WeavePrediction(NamedTuple):
    """What WeaveNet's losses need of a batch.

    Attributes:
        stages: Results of every stage.
        amplification: Mean excess of the slopes of the upsamplings; None if the recipe has no loss on it.
        lesson: The teacher's results; None if the recipe has no teacher.
    """

    stages: WeaveStages
    amplification: Float[Tensor, ""] | None = None
    lesson: Lesson | None = None


class WeaveObjective:
    """Objective for WeaveNet: disparities of both views, with supervision of every stage.

    With an exponent above 1, the regression compares codes of a `DepthCurve` times max_disparity_px. With
    an exponent of 1, it compares disparities in pixels.
    """

    recordable = False  # only rendered pairs have cameras, so the batches of a mix differ

    def __init__(self, recipe: Recipe, teacher: Teacher | None = None) -> None:
        self.recipe, self.teacher = recipe, teacher

    def check(self, batch: Batch) -> None:
        """Accept every batch: truth that the network cannot predict enters no loss."""

    def predict(self, network: WeaveNet, batch: Batch) -> WeavePrediction:
        views = batch["left"], batch["right"]
        lesson = self.teacher.teach(*views) if self.teacher else None
        if not self.recipe.steadiness:
            return WeavePrediction(network.stages(*views), lesson=lesson)
        share = self.recipe.steadiness_share
        if share == 1 or torch.rand(()) < share:
            return WeavePrediction(*predict_with_amplification(network, *views), lesson)
        # All micro-batches of a step have the same terms.
        return WeavePrediction(network.stages(*views), batch["left"].new_zeros(()), lesson)

    def losses(self, predicted: WeavePrediction, batch: Batch) -> dict[str, Tensor]:
        stages, recipe = predicted.stages, self.recipe
        truth_px, occluded = batch["disparity_px"], batch["occluded"]
        terms = weave_losses(stages, truth_px, occluded, recipe.distribution, self._compare)
        if recipe.alpha_p:
            left_px = stages.disparity_px.chunk(2)[0]
            terms["projection"] = recipe.alpha_p * projection_loss(batch["left"], batch["right"], left_px)
        if predicted.amplification is not None:
            terms["steadiness"] = recipe.steadiness * predicted.amplification
        if predicted.lesson is not None:
            taught = distillation_losses(stages, predicted.lesson, self._compare)
            terms |= {name: recipe.taught * term for name, term in taught.items()}
        return terms

    def scores(self, network: WeaveNet, pairs: PairSource, device: torch.device) -> dict[str, float]:
        return validate(network, pairs, device)

    def _compare(self, estimate_px: Tensor, truth_px: Tensor) -> Tensor:
        return regression_loss(self._encode(estimate_px), self._encode(truth_px), self.recipe.robust)

    def _encode(self, disparity_px: Tensor) -> Tensor:
        if self.recipe.exponent == 1:
            return disparity_px  # unchanged to the last bit
        curve = DepthCurve(exponent=self.recipe.exponent, max_disparity_px=self.recipe.max_disparity_px)
        return self.recipe.max_disparity_px * curve.encode_estimate(disparity_px)


class CodeObjective:
    """Objective of the paper's equation (5), between codes of a `DepthCurve`, for the left view.

    Disparities in pixels are converted to the same code, so that every network can train on every target
    and with every loss. With loss = "smooth_l1" (or "l1"), exponent = 1 and alpha_p = 0, this is PSMNet's (or
    DispNet's) own loss up to the factor 1 / d_max, to which Adam is invariant.
    """

    recordable = True

    def __init__(self, recipe: Recipe, network: CodeNetwork) -> None:
        self.recipe, self.curve = recipe, build_curve(recipe)
        self.predicts, self.output_weights = network.predicts, network.output_weights
        self.compare = _choose_comparison(recipe)

    def check(self, batch: Batch) -> None:
        self.curve.check(compute_target(self.recipe, batch))

    def predict(self, network: CodeNetwork, batch: Batch) -> tuple[Map, ...]:
        return network.outputs(batch["left"], batch["right"])

    def losses(self, predicted: tuple[Map, ...], batch: Batch) -> dict[str, Tensor]:
        # Unchecked, because a check waits for the GPU; `check` has seen the batch.
        truth = self.curve.encode_estimate(compute_target(self.recipe, batch))
        terms = [self._terms(output.float(), truth, batch) for output in predicted]
        weighted = list(zip(self.output_weights, terms, strict=True))
        # No tensor of weights: a CUDA graph cannot record its copy to the GPU.
        return {name: torch.stack([w * term[name] for w, term in weighted]).sum() for name in terms[0]}

    def code(self, output: Map, batch: Batch) -> Map:
        """Convert a network's output to a code."""
        return output if self.predicts == "code" else self.curve.encode_estimate(self.quantity(output, batch))

    def quantity(self, output: Map, batch: Batch) -> Map:
        """Convert a network's output to the target quantity: disparity in px, or depth in m."""
        if self.predicts == "code":
            return self.curve.decode(output)
        return output if self.recipe.target == "disparity" else self._depth_m(output, batch)

    def disparity_px(self, output: Map, batch: Batch) -> Map:
        """Convert a network's output to disparity in pixels."""
        if self.predicts == "disparity_px":
            return output
        decoded = self.curve.decode(output)
        if self.recipe.target == "disparity":
            return decoded
        return depth_to_disparity(
            decoded, batch["focal_baseline_px_m"], batch["doffs_px"], width_px=output.shape[3]
        )

    @torch.no_grad()
    def scores(self, network: CodeNetwork, pairs: PairSource, device: torch.device) -> dict[str, float]:
        """Return the means of the loss, its terms and the errors over held-out pairs.

        `squared_error` is the squared error of the linear code, without the exponent. Unlike the loss, it can
        be compared across exponents. `depth_error_m` is returned only if the target is depth.
        """
        network.eval()
        rows = []
        for index in range(pairs.count):
            with name_in_errors(pairs.name(index)):
                rows.append(self._score_sample(network, read_known(pairs, index), device))
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    def _terms(self, output: Map, code_truth: Map, batch: Batch) -> dict[str, Tensor]:
        terms = {"prediction": self.recipe.alpha_z * self.compare(self.code(output, batch), code_truth)}
        if self.recipe.alpha_p:
            disparity_px = self.disparity_px(output, batch)
            error = projection_loss(batch["left"], batch["right"], disparity_px)
            terms["projection"] = self.recipe.alpha_p * error
        return terms

    def _depth_m(self, disparity_px: Map, batch: Batch) -> Map:
        """Return the depth of an estimated disparity, extended along the tangent beyond max_depth_m.

        The extension is finite and has a gradient even for disparities of 0 or less, which an untrained
        network may predict.
        """
        focal_baseline, shifted_px = batch["focal_baseline_px_m"], disparity_px + batch["doffs_px"]
        least_px = focal_baseline / self.recipe.max_depth_m
        beyond = (1 - shifted_px / least_px).clamp(min=0)
        return focal_baseline / shifted_px.clamp(min=least_px) + beyond * self.recipe.max_depth_m

    def _score_sample(self, network: CodeNetwork, sample: Sample, device: torch.device) -> dict[str, float]:
        batch = {name: values.to(device) for name, values in collate([sample]).items()}
        output, truth = network(batch["left"], batch["right"]), compute_target(self.recipe, batch)
        terms = self._terms(output, self.curve.encode(truth), batch)
        scores = {name: float(value) for name, value in terms.items()}
        quantity = self.quantity(output, batch)
        straight = build_curve(replace(self.recipe, exponent=1.0))
        error = (straight.encode_estimate(quantity) - straight.encode(truth)).square()
        scores["loss"] = sum(scores.values())
        scores["squared_error"] = float(error.nanmean())
        scores["epe_px"] = metrics.epe_px(_to_array(self.disparity_px(output, batch)), sample.disparity_px)
        if self.recipe.target == "depth":
            estimate_m = _to_array(quantity.clamp(max=self.recipe.max_depth_m))
            scores["depth_error_m"] = metrics.depth_error_m(estimate_m, _to_array(truth))
        return scores


def _choose_comparison(recipe: Recipe) -> Callable[[Map, Map], Tensor]:
    """Return the loss function between a predicted and a true code."""
    if recipe.loss == PERCEPTUAL:
        if not recipe.vgg16_weights:
            raise FormatError(
                f"{recipe.name}: vgg16_weights: expected the path of torchvision's vgg16-397923af.pth for "
                f"loss = {PERCEPTUAL!r}, found none; the file is never downloaded automatically"
            )
        return PerceptualLoss(Path(recipe.vgg16_weights))
    if recipe.loss == SMOOTH_L1:
        # For linear codes of disparity, the loss switches at 1 px, as published.
        return partial(smooth_l1_loss, beta=1 / recipe.max_disparity_px)
    return CODE_LOSSES[recipe.loss]


def build_curve(recipe: Recipe) -> DepthCurve:
    """Build the curve that converts a recipe's target to a code."""
    if recipe.target == "depth":
        return DepthCurve(exponent=recipe.exponent, max_depth_m=recipe.max_depth_m)
    return DepthCurve(exponent=recipe.exponent, max_disparity_px=recipe.max_disparity_px)


def fit_recipe(recipe: Recipe, pairs: PairSource) -> Recipe:
    """Return the recipe, with its exponent fitted to the training pairs if `fit_exponent` is set."""
    if not recipe.fit_exponent:
        return recipe
    return replace(recipe, exponent=fit_exponent(count_truth(recipe, pairs)))


def count_truth(recipe: Recipe, pairs: PairSource) -> Float[np.ndarray, " n"]:
    """Return a histogram of linear codes of the ground truth, in equal bins, over evenly spaced pairs."""
    straight = build_curve(replace(recipe, exponent=1.0))
    counts = np.zeros(_FITTED_BINS)
    for index in range(0, pairs.count, max(1, pairs.count // _FITTED_PAIRS)):
        with name_in_errors(pairs.name(index)):
            code = _to_array(straight.encode(compute_target(recipe, collate([read_known(pairs, index)]))))
        counts += np.histogram(code[np.isfinite(code)], _FITTED_BINS, (0, 1))[0]
    return counts


def compute_target(recipe: Recipe, batch: Batch) -> Map:
    """Return the left views' truth as the recipe's target: disparity in px or depth in m; NaN where unknown.

    Disparity above max_disparity_px counts as unknown, as in PSMNet's code. Depth beyond max_depth_m is
    returned, and is later rejected as an error.
    """
    disparity_px = batch["disparity_px"][: len(batch["left"])]
    if recipe.target == "disparity":
        return disparity_px.where(disparity_px <= recipe.max_disparity_px, torch.nan)
    if "focal_baseline_px_m" not in batch:
        raise StereoweaveError(
            f"{recipe.name}: target = 'depth': expected pairs with a camera, found dataset = "
            f"{recipe.dataset!r} without cameras; train on disparity"
        )
    depth_m = batch["focal_baseline_px_m"] / (disparity_px + batch["doffs_px"])
    # A depth of exactly max_depth_m, stored as disparity, may come back larger by a rounding error.
    return depth_m.where(depth_m > 1.0001 * recipe.max_depth_m, depth_m.clamp(max=recipe.max_depth_m))


@contextmanager
def name_in_errors(what: str) -> Iterator[None]:
    """Prefix each StereoweaveError raised in the block with `what`, the name of the pairs, but only once."""
    try:
        yield
    except StereoweaveError as error:
        words = str(error)
        raise StereoweaveError(words if words.startswith(what) else f"{what}: {words}") from error


def _to_array(values: Map) -> Float[np.ndarray, "h w"]:
    return values[0, 0].cpu().numpy()
