"""Scores of a network on pairs that it was not trained on."""

import numpy as np
import torch
from torch import nn

from stereoweave import metrics
from stereoweave.learn.sources import Source


@torch.no_grad()
def validate(network: nn.Module, pairs: Source, device: torch.device) -> dict[str, float]:
    """Mean scores over the left views of the pairs, occluded pixels included."""
    network.eval()
    rows, confidences, truths = [], [], []
    for index in range(pairs.count):
        sample = pairs[index]
        left, right = (
            torch.from_numpy(image).permute(2, 0, 1)[None].to(device).float() / 255
            for image in (sample.left, sample.right)
        )
        found_px, _, confidence_logit = (x[0, 0].float().cpu() for x in network(left, right))
        estimate_px, truth_px = found_px.numpy(), sample.disparity_px
        rows.append(
            {
                "epe_px": metrics.epe_px(estimate_px, truth_px),
                "bad1_percent": metrics.bad_percent(estimate_px, truth_px, 1),
                "bad2_percent": metrics.bad_percent(estimate_px, truth_px, 2),
                "d1_percent": metrics.d1_percent(estimate_px, truth_px),
            }
        )
        confidences.append(confidence_logit.sigmoid().numpy())
        truths.append(np.abs(estimate_px - truth_px) <= 1)
    scores = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return scores | {"calibration_error": metrics.calibration_error(np.stack(confidences), np.stack(truths))}
