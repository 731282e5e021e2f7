"""Registry of the networks, keyed by their names in recipes."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

from torch import Tensor

from stereoweave.arguments import suggest
from stereoweave.errors import FormatError
from stereoweave.learn.models.densemapnet import DenseMapNet
from stereoweave.learn.models.dispnet import DispNet
from stereoweave.learn.models.fast_depth import FastDepthNet
from stereoweave.learn.models.ganet import GANET_11, GANET_DEEP, GANet
from stereoweave.learn.models.mc_cnn import MCCNN
from stereoweave.learn.models.psmnet import PSMNet
from stereoweave.learn.models.scvnet import SCVNet
from stereoweave.learn.models.weave import BASE, BASE_GROWN, SMALL, WeaveNet
from stereoweave.learn.models.weave_half import WeaveHalfNet
from stereoweave.learn.recipe import Recipe

MODELS: dict[str, Callable[..., Any]] = {
    "weave_small": partial(WeaveNet, SMALL),
    "weave_base": partial(WeaveNet, BASE),
    "weave_base_grown": partial(WeaveNet, BASE_GROWN),
    "weave_half": WeaveHalfNet,
    "fast_depth": FastDepthNet,
    "fast_depth_without_skips": partial(FastDepthNet, skips=False),
    "densemapnet": DenseMapNet,
    "dispnet": DispNet,
    "psmnet": PSMNet,
    "mc_cnn": MCCNN,
    "scvnet": SCVNet,
    "ganet_11": partial(GANet, GANET_11),
    "ganet_deep": partial(GANet, GANET_DEEP),
}
# Networks with candidate disparities, which have the end of the range as an argument.
_RANGED = "psmnet", "scvnet", "ganet_11", "ganet_deep"


@runtime_checkable
class CodeNetwork(Protocol):
    """Interface of the paper's network and of the networks with which it is compared.

    Such a network maps a pair of images [B, 3, H, W] in 0..1, of any size, to one map [B, 1, H, W].

    Attributes:
        predicts: Whether the map holds the code of a `DepthCurve` or the disparity in pixels.
        output_weights: Loss weight of each of `outputs`.
    """

    predicts: Literal["code", "disparity_px"]
    output_weights: tuple[float, ...]

    def outputs(self, left: Tensor, right: Tensor) -> tuple[Tensor, ...]:
        """Return all supervised outputs; the last one is the estimate."""
        ...

    def __call__(self, left: Tensor, right: Tensor) -> Tensor:
        """Return the estimate."""
        ...

    def eval(self) -> Any: ...


def build_network(recipe: Recipe) -> Any:
    """Build a recipe's network with random weights. Raises FormatError if its name is unknown."""
    if recipe.model not in MODELS:
        raise FormatError(
            f"{recipe.name}: model = {recipe.model!r}, expected one of {', '.join(MODELS)}"
            + suggest(recipe.model, list(MODELS))
        )
    if recipe.model in _RANGED:
        return MODELS[recipe.model](max_disparity_px=int(recipe.max_disparity_px))
    return MODELS[recipe.model]()
