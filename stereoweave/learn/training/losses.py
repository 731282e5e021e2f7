"""Loss functions, which reduce maps [B, 1, H, W] to a scalar. NaN in the ground truth is ignored.

`weave_losses` and its terms are for WeaveNet. `CODE_LOSSES` and `projection_loss` are the losses of
"Fast Depth Estimation for View Synthesis", for networks that predict the code of a `DepthCurve`. The
perceptual loss needs weights and is in perceptual.py.
"""

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stereoweave.learn.models.weave import WeaveStages
from stereoweave.learn.training.warp import reconstruct_left

_ROBUST_SCALE = 2.5
# Upsampling logits beyond this magnitude change no pixel's share noticeably: sigmoid(8) is 0.9997.
_LARGEST_LOGIT = 8.0


def weave_losses(
    stages: WeaveStages,
    truth_px: Float[Tensor, "b 1 h w"],
    occluded: Bool[Tensor, "b 1 h w"],
    distribution: float = 1.0,
    compare: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> dict[str, Tensor]:
    """Return the weighted terms of WeaveNet's loss by name; training minimises their sum.

    Ground truth beyond the last level counts as unknown. Ground truth below 0 px, which the network cannot
    predict, counts only in the confidence loss.

    Args:
        stages: Predictions for both views; the second half of the batch is mirrored.
        truth_px: Ground-truth disparity of the same views; NaN where unknown.
        occluded: Pixels without a match; excluded from the loss of the raw correlation.
        distribution: Weight of the cross-entropies.
        compare: Loss between estimated and true disparities in px. Default: `regression_loss`.
    """
    compare = compare or regression_loss
    columns = torch.arange(truth_px.shape[3], device=truth_px.device)
    unmatched = occluded | (truth_px > columns)
    # Pixels per level, which is also the factor by which the score maps are smaller.
    step = truth_px.shape[3] // stages.scores.shape[3]
    centres = (..., slice(step // 2 - 1, None, step), slice(step // 2 - 1, None, step))
    reach_px = step * (stages.scores.shape[1] - 1)
    truth_px = truth_px.where(truth_px <= reach_px, torch.nan)
    ahead_px = truth_px.where(truth_px >= 0, torch.nan)
    level_truth = truth_px[centres] / step
    matched_truth = level_truth.masked_fill(unmatched[centres], torch.nan)
    return {
        "correlation": 0.5 * distribution * level_cross_entropy(stages.correlation, matched_truth),
        "scores": distribution * level_cross_entropy(stages.scores, level_truth),
        "coarse": 0.5 * compare(stages.coarse_px, halve(ahead_px)),
        "disparity": compare(stages.disparity_px, ahead_px),
        "confidence": 0.3 * confidence_loss(stages.confidence_logit, stages.disparity_px, truth_px),
        "logits": 0.02 * torch.stack([excess_loss(logits) for logits in stages.upsampling_logits]).sum(),
    }


def level_cross_entropy(
    scores: Float[Tensor, "b d h w"], truth: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, ""]:
    """Return the cross-entropy over levels, with the target split linearly between its two nearest levels."""
    levels = scores.shape[1]
    known = (truth >= 0) & (truth <= levels - 1)
    truth = truth.where(known, 0)
    below = truth.floor().clamp(max=levels - 2)
    log_likelihood = scores.float().log_softmax(1)
    low, high = (log_likelihood.gather(1, below.long() + i) for i in (0, 1))
    return -masked_mean(low + (truth - below) * (high - low), known)


def regression_loss(
    estimate_px: Float[Tensor, "b 1 h w"], truth_px: Float[Tensor, "b 1 h w"], robust: float = 0.0
) -> Float[Tensor, ""]:
    """Return the mean absolute error, quadratic below 0.5 px and optionally blended with a logarithm.

    The share `robust` of each error e is replaced by 2.5 log(1 + e), whose gradient is largest for small
    errors, which almost count as correct.
    """
    known = truth_px.isfinite()
    # Unknown truth is replaced first, because NaN times a mask is NaN, in the gradient too.
    loss = F.huber_loss(estimate_px, truth_px.where(known, 0), reduction="none", delta=0.5) / 0.5
    if robust:
        loss = (1 - robust) * loss + robust * _ROBUST_SCALE * loss.log1p()
    return masked_mean(loss, known)


def confidence_loss(
    logit: Float[Tensor, "b 1 h w"],
    disparity_px: Float[Tensor, "b 1 h w"],
    truth_px: Float[Tensor, "b 1 h w"],
) -> Float[Tensor, ""]:
    """Return the binary cross-entropy of the probability that the disparity is within 1 px of the truth."""
    within = (disparity_px.detach() - truth_px).abs() <= 1
    loss = F.binary_cross_entropy_with_logits(logit, within.float(), reduction="none")
    return masked_mean(loss, truth_px.isfinite())


def excess_loss(logits: Float[Tensor, "b k h w"]) -> Float[Tensor, ""]:
    """Return the mean excess of the logits' magnitude over 8.

    Without this loss the logits grow to thousands, and amplify rounding errors at depth edges.
    """
    return (logits.abs() - _LARGEST_LOGIT).clamp(min=0).mean()


def halve(truth_px: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 1 h2 w2"]:
    """Return the mean of each 2x2 block, in pixels of full resolution; NaN where a block spans an edge."""
    blocks = F.pixel_unshuffle(truth_px, 2)
    low, high = blocks.aminmax(dim=1, keepdim=True)
    return blocks.mean(1, keepdim=True).where(high - low < 1, torch.nan)


def l2_loss(code: Float[Tensor, "b 1 h w"], truth: Float[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
    """Return the mean squared error of the code: the first term of the paper's equation (5)."""
    return _mean_known_loss(F.mse_loss, code, truth)


def l1_loss(code: Float[Tensor, "b 1 h w"], truth: Float[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
    """Return the mean absolute error of the code."""
    return _mean_known_loss(F.l1_loss, code, truth)


def smooth_l1_loss(
    code: Float[Tensor, "b 1 h w"], truth: Float[Tensor, "b 1 h w"], beta: float = 1 / 192
) -> Float[Tensor, ""]:
    """Return the smooth L1 loss of the code: quadratic below beta, and absolute error minus beta / 2 above.

    PSMNet and others switch at 1 px. For a code with exponent 1, this is 1 / max_disparity_px. The default
    of 1 / 192 matches PSMNet's range.
    """
    return _mean_known_loss(partial(F.smooth_l1_loss, beta=beta), code, truth)


def cross_entropy_loss(code: Float[Tensor, "b 1 h w"], truth: Float[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
    """Return the mean binary cross-entropy of codes in 0..1, which is lowest, but not 0, at the true code.

    PyTorch clamps the loss to 100 and its gradient to 1e12, so both are finite where a code is exactly 0 or
    1. A sigmoid with such an output has a slope of 0, so the network learns nothing there.
    """
    return _mean_known_loss(F.binary_cross_entropy, code, truth)


CODE_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "l2": l2_loss,
    "l1": l1_loss,
    "smooth_l1": smooth_l1_loss,
    "cross_entropy": cross_entropy_loss,
}


def projection_loss(
    left: Float[Tensor, "b c h w"], right: Float[Tensor, "b c h w"], disparity_px: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, ""]:
    """Return the mean squared difference between the left image and its reconstruction from the right image.

    This is the second term of the paper's equation (5). The mean is over all pixels of the batch whose match
    lies inside the right image; the loss is 0 if there are none.

    The paper specifies neither the range nor the channels of images. Here, images are in 0..1, like the code,
    so that the weights of both terms are comparable. Channels are averaged, so that grey and colour images
    weigh the same.
    """
    reconstructed, exists = reconstruct_left(right, disparity_px)
    return masked_mean(((reconstructed - left) ** 2).mean(1, keepdim=True), exists)


def masked_mean(values: Float[Tensor, "..."], known: Bool[Tensor, "..."]) -> Float[Tensor, ""]:
    """Return the mean of the known values; 0, with a gradient of 0, if there are none."""
    return values.where(known, 0).sum() / known.sum().clamp(min=1)


def _mean_known_loss(loss: Callable[..., Tensor], code: Tensor, truth: Tensor) -> Tensor:
    known = truth.isfinite()
    # Unknown truth is replaced first, because NaN times a mask is NaN, in the gradient too.
    return masked_mean(loss(code, truth.where(known, 0), reduction="none"), known)
