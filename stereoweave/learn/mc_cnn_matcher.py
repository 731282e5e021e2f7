"""MC-CNN as a matcher for `bench pairs`: its network, followed by the steps of its paper."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from stereoweave.bench.mc_cnn.steps import (
    AGGREGATED,
    FAST,
    DescribedView,
    find_disparity,
    find_nearest_vectors,
)
from stereoweave.bench.opencv_matchers import DISPARITIES, LEAST_PX, MapMatch
from stereoweave.errors import StereoweaveError
from stereoweave.learn.models.mc_cnn import MCCNN, load_weights, standardise
from stereoweave.stereo import Sample, StereoPair
from stereoweave.system.threads import thread_count

Steps = Callable[[DescribedView, DescribedView, int], Float32[np.ndarray, "h w"]]

STEPS: dict[str, Steps] = {
    " raw": find_nearest_vectors,
    "": partial(find_disparity, settings=FAST),
    " aggregated": partial(find_disparity, settings=AGGREGATED),
}
"""What follows the network, by the end of the matcher's name."""


def list_mc_cnns(files: Sequence[Path], threads: int | None) -> dict[str, Callable[[], MapMatch]]:
    """Return factories of matchers by name: for each file, its stem and each of STEPS.

    Raises:
        StereoweaveError: Two files have the same stem.
    """
    stems = [file.stem for file in files]
    if twice := [stem for stem in stems if stems.count(stem) > 1]:
        raise StereoweaveError(f"{twice[0]}: expected weight files of different names, found two; rename one")
    # Absolute, because cluster workers have another current folder.
    return {
        file.stem + steps: partial(make_mc_cnn, str(file.absolute()), steps, threads)
        for file in files
        for steps in STEPS
    }


def make_mc_cnn(weights: str, steps: str, threads: int | None = None) -> MapMatch:
    """Return a matcher over 192 disparities.

    Args:
        weights: File for `load_weights`, which has its errors.
        steps: Key of STEPS.
        threads: Number of threads of the network, for the whole process. Default: one per core.
    """
    network, find = load_weights(Path(weights)), STEPS[steps]
    torch.set_num_threads(thread_count(threads))

    def match(pair: StereoPair) -> Float32[np.ndarray, "h w"]:
        left, right = (describe(network, view) for view in (pair.left, pair.right))
        return find(left, right, DISPARITIES).clip(min=LEAST_PX)

    return match


def match_sample(network: MCCNN, candidates: int, sample: Sample) -> Float32[np.ndarray, "h w"]:
    """Return the left disparity of a sample in px, after the steps that the paper chose for Middlebury."""
    left, right = (describe(network, view) for view in (sample.left, sample.right))
    return find_disparity(left, right, candidates, FAST)


@torch.no_grad()
def describe(network: MCCNN, view: UInt8[np.ndarray, "h w 3"]) -> DescribedView:
    """Return the levels and vectors of a view, as the steps take them."""
    device = next(network.parameters()).device
    image = torch.from_numpy(np.ascontiguousarray(view)).permute(2, 0, 1)[None].to(device).float() / 255
    grey = standardise(image)
    vectors = network.describe(grey)[0].permute(1, 2, 0).contiguous()
    return DescribedView(grey=grey[0, 0].cpu().numpy(), vectors=vectors.cpu().numpy())
