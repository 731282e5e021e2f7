"""Calibration of a network's confidence on held-out pairs."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from stereoweave.bench.metrics import calibration_bins, calibration_error
from stereoweave.io.files import replacing
from stereoweave.learn.data.collage import paint_collage
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.stereo import Sample, StereoPair

# Different from the seeds of recipes and validation.
_FIT_SEED, _PROOF_SEED = 2_000_003, 3_000_017
_PAIRS = 24
_SIZE = (320, 512)


def calibrate_confidence(network: WeaveNet) -> dict[str, Any]:
    """Calibrate the network's confidence in place. Returns the reliability on other pairs.

    A scale and a shift of the logits (Platt 1999) are fitted and folded into the last layer. The reliability
    is measured on pairs that were not used for the fit. It consists of the `calibration_error` and, for each
    confidence bin, the `claimed` probability that the error is within 1 px, the share of its pixels for which
    it is (`happened`), and the bin's `share` of all pixels.
    """
    scale, shift = _fit_scale_and_shift(*_predict_claims(network, _FIT_SEED))
    with torch.no_grad():
        layer = network.refinements[-1].confidence
        assert layer.bias is not None
        layer.weight *= scale
        layer.bias.mul_(scale).add_(shift)
    logits, within = _predict_claims(network, _PROOF_SEED)
    return measure_reliability(logits.sigmoid().numpy(), within.numpy())


def measure_reliability(probability: np.ndarray, happened: np.ndarray) -> dict[str, Any]:
    """Return claimed and observed probabilities in equal-width bins, and the expected calibration error."""
    bins = calibration_bins(probability, happened).round(4).T.tolist()
    rows = [dict(zip(("claimed", "happened", "share"), row, strict=True)) for row in bins]
    return {"calibration_error": round(calibration_error(probability, happened), 4), "bins": rows}


def paint_unseen_pair() -> StereoPair:
    """Paint a collage that is never used in training."""
    made = paint_collage(_PROOF_SEED, 1, 0, *_SIZE)
    return StereoPair(left=made.left, right=made.right)


def _predict_claims(network: WeaveNet, seed: int) -> tuple[Tensor, Tensor]:
    """Return confidence logits, and whether the error is within 1 px, at every 29th pixel of unseen pairs."""
    logits, within = [], []
    for index in range(_PAIRS):
        made = paint_collage(seed, 0, index, *_SIZE)
        with torch.no_grad():
            disparity_px, _, logit = network(_to_tensor(made, "left"), _to_tensor(made, "right"))
        error_px = (disparity_px[0, 0] - torch.from_numpy(made.disparity_px)).abs()
        logits.append(logit.flatten()[::29])
        within.append(error_px.flatten()[::29] <= 1)
    return torch.cat(logits), torch.cat(within)


def _to_tensor(made: Sample, side: str) -> Tensor:
    return torch.from_numpy(getattr(made, side)).permute(2, 0, 1)[None].float() / 255


def _fit_scale_and_shift(logits: Tensor, within: Tensor) -> tuple[float, float]:
    """Fit the scale and shift of the logits by maximum likelihood."""
    parameters = torch.tensor([1.0, 0.0], requires_grad=True)
    optimiser = torch.optim.LBFGS([parameters], max_iter=50)

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = F.binary_cross_entropy_with_logits(logits * parameters[0] + parameters[1], within.float())
        value.backward()  # type: ignore[no-untyped-call]
        return value

    optimiser.step(loss)  # type: ignore[no-untyped-call]
    scale, shift = parameters.tolist()
    return scale, shift


def draw_reliability(reliability: dict[str, Any], picture: Path) -> None:
    """Plot the observed against the claimed probability, with the share of pixels in each bin below."""
    from matplotlib.figure import Figure

    bins = reliability["bins"]
    claimed, happened, share = ([row[key] for row in bins] for key in ("claimed", "happened", "share"))
    figure = Figure(figsize=(4.5, 5.5), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3, 1), sharex=True)
    above.plot([0, 1], [0, 1], color="0.7", linestyle="--", label="perfect calibration")
    above.plot(claimed, happened, marker="o", label="measured")
    above.set(ylabel="share within 1 px", xlim=(0, 1), ylim=(0, 1))
    above.set_title(f"expected calibration error {reliability['calibration_error']:.3f}")
    above.legend(loc="upper left", frameon=False)
    below.bar(claimed, share, width=0.05, color="0.6")
    below.set(xlabel="confidence", ylabel="share of pixels")
    with replacing(picture) as temporary:
        figure.savefig(temporary, dpi=120)
