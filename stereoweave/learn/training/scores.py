"""Validation scores of a network on held-out pairs."""

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from stereoweave.bench import metrics
from stereoweave.bench.error_classes import CLASSES, class_errors, classify
from stereoweave.learn.data.sources import PairSource
from stereoweave.learn.models.layers import predict_any_size
from stereoweave.stereo import Sample

Map = Float[np.ndarray, "h w"]


@torch.no_grad()
def validate(network: nn.Module, pairs: PairSource, device: torch.device) -> dict[str, float]:
    """Return mean scores over the left views of the pairs, including occluded pixels."""
    rows, confidences, hits = [], [], []
    for sample, estimate_px, confidence in _predict(network, pairs, device):
        rows.append(_compute_errors(estimate_px, sample.disparity_px))
        known = np.isfinite(sample.disparity_px)
        confidences.append(confidence[known])
        hits.append(np.abs(estimate_px - sample.disparity_px)[known] <= 1)
    return _average(rows) | {
        "calibration_error": metrics.calibration_error(np.concatenate(confidences), np.concatenate(hits))
    }


@torch.no_grad()
def validate_by_class(network: nn.Module, pairs: PairSource, device: torch.device) -> dict[str, float]:
    """Return mean scores over the left views, and the contribution of each class of pixels to bad-1.

    Ground truth beyond the network's range is ignored.
    """
    rows = []
    for sample, estimate_px, _ in _predict(network, pairs, device):
        truth_px = np.where(sample.disparity_px < network.max_disparity_px, sample.disparity_px, np.nan)
        classes = class_errors(
            estimate_px, truth_px, classify(sample.left, truth_px, occluded=sample.occluded)
        )
        bad1_percent = {f"{name}_bad1_percent": classes[name].bad1_percent for name in CLASSES}
        rows.append(_compute_errors(estimate_px, truth_px) | bad1_percent)
    return _average(rows)


def validate_sets(
    network: nn.Module, sets: Mapping[str, PairSource], device: torch.device
) -> dict[str, float]:
    """Return the scores of `validate_by_class` on each set, each named SET_SCORE."""
    return {
        f"{name}_{score}": value
        for name, pairs in sets.items()
        for score, value in validate_by_class(network, pairs, device).items()
    }


def _predict(
    network: nn.Module, pairs: PairSource, device: torch.device
) -> Iterator[tuple[Sample, Map, Map]]:
    """Yield each sample with the network's left disparity in px and its confidence."""
    network.eval()
    for index in range(pairs.count):
        sample = pairs[index]
        left, right = (
            torch.from_numpy(image).permute(2, 0, 1)[None].to(device).float() / 255
            for image in (sample.left, sample.right)
        )
        found_px, _, confidence_logit = (
            x[0, 0].float().cpu() for x in predict_any_size(network, left, right)
        )
        yield sample, found_px.numpy(), confidence_logit.sigmoid().numpy()


def _compute_errors(estimate_px: Map, truth_px: Map) -> dict[str, float]:
    return {
        "epe_px": metrics.epe_px(estimate_px, truth_px),
        "bad1_percent": metrics.bad_percent(estimate_px, truth_px, 1),
        "bad2_percent": metrics.bad_percent(estimate_px, truth_px, 2),
        "d1_percent": metrics.d1_percent(estimate_px, truth_px),
    }


def _average(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
