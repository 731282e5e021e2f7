"""Depth and new views from a stereo pair."""

import importlib
from typing import TYPE_CHECKING, Any

from stereoweave.system.telemetry import disable_telemetry

if TYPE_CHECKING:
    from stereoweave.errors import FormatError, MatcherError, StereoweaveError
    from stereoweave.io.images import read_image
    from stereoweave.matching.matcher import Matcher
    from stereoweave.matching.opencv_interface.stereo_matcher import StereoMatcher
    from stereoweave.pictures.estimate import estimate
    from stereoweave.rendering.comfort import fit_screen
    from stereoweave.rendering.renderer import render
    from stereoweave.rendering.synthesize import synthesize
    from stereoweave.stereo import DepthCurve, Estimate, Sample, StereoCamera, StereoPair, View

__version__ = "0.2.0"

_HOMES = {
    "DepthCurve": "stereo",
    "Estimate": "stereo",
    "FormatError": "errors",
    "Matcher": "matching.matcher",
    "MatcherError": "errors",
    "Sample": "stereo",
    "StereoCamera": "stereo",
    "StereoMatcher": "matching.opencv_interface.stereo_matcher",
    "StereoPair": "stereo",
    "StereoweaveError": "errors",
    "View": "stereo",
    "estimate": "pictures.estimate",
    "fit_screen": "rendering.comfort",
    "read_image": "io.images",
    "render": "rendering.renderer",
    "synthesize": "rendering.synthesize",
}

__all__ = [
    "DepthCurve",
    "Estimate",
    "FormatError",
    "Matcher",
    "MatcherError",
    "Sample",
    "StereoCamera",
    "StereoMatcher",
    "StereoPair",
    "StereoweaveError",
    "View",
    "__version__",
    "estimate",
    "fit_screen",
    "read_image",
    "render",
    "synthesize",
]


# Runs before any other module of the package is imported, in every process.
disable_telemetry()


# Type checkers would take every name as existing if they saw this function.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Import a public name on first access (PEP 562), so that importing the package is fast."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
