"""Strength and convergence with which a chosen screen shows a scene without strain to the eyes.

The parallax of a point on the screen is its disparity between the two eyes' views, in percent of the width of
the picture; positive in front of the screen. A screen has a depth budget: the largest parallax in front of it
and behind it. Sources:

- Sky, "BSkyB Technical Guidelines for Plano Stereoscopic (3D) Programme Content", 2010: on televisions of 46
  to 70 inches, subjects lie within 1 % in front of the screen and 2 % behind it.
- M. Lambooij, W. IJsselsteijn, M. Fortuin and I. Heynderickx, "Visual Discomfort and Visual Fatigue of
  Stereoscopic Displays: A Review", 2009: disparities of up to one degree of visual angle are comfortable.
- T. Shibata, J. Kim, D. M. Hoffman and M. S. Banks, "The Zone of Comfort", 2011: on near screens, depth in
  front of the screen is less comfortable than depth behind it.
- B. Mendiburu, "3D Movie Making", 2009: the parallax of the farthest points must not exceed the distance of
  the eyes, 65 mm (native parallax), because eyes do not diverge.
- M. Zwicker, W. Matusik, F. Durand and H. Pfister, "Antialiasing for Automultiscopic 3D Displays", 2006: what
  moves by more than a pixel from one view of a light-field display to the next is blurred or doubled.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from stereoweave.arguments import check_choice, check_kind
from stereoweave.rendering.renderer import check_convergence_px, check_strength
from stereoweave.stereo import Estimate

CONFIDENT = 0.5
# Fewer confident pixels than this do not show a scene's range.
_LEAST_CONFIDENT_SHARE = 0.02
_OUTER_PERCENT = 1.0
# About this many pixels are enough for percentiles.
_SAMPLED_PIXELS = 40_000
_ROUNDING_PX = 1e-6


@dataclass(frozen=True, kw_only=True)
class Screen:
    """A kind of screen, and its depth budget.

    Attributes:
        front_percent: Largest parallax in front of the screen, in percent of the picture's width.
        behind_percent: Largest parallax behind the screen, likewise.
        width_m, distance_m: Width and distance of the picture that the budget assumes.
    """

    front_percent: float
    behind_percent: float
    width_m: float
    distance_m: float


SCREENS: dict[str, Screen] = {
    # One degree is 3.5 % at this distance; less in front, which is less comfortable on near screens.
    "phone": Screen(front_percent=2.5, behind_percent=3.4, width_m=0.15, distance_m=0.3),
    # Sky's budget, for 55 inches seen from three heights of the picture.
    "television": Screen(front_percent=1.0, behind_percent=2.0, width_m=1.22, distance_m=2.06),
    # A video 60 degrees wide at the distance to which headsets focus. One degree is 1.5 %.
    "headset": Screen(front_percent=1.5, behind_percent=1.5, width_m=1.5, distance_m=1.3),
    # The views of the two cameras are 23.5 views of a quilt apart, and a view is about 512 px wide. One pixel
    # from view to view is 4.6 %.
    "light_field": Screen(front_percent=4.0, behind_percent=4.0, width_m=0.34, distance_m=0.6),
}


class Depth(NamedTuple):
    """Disparities of a scene in px: the nearest, the farthest and the median one, without outliers."""

    near_px: float
    far_px: float
    middle_px: float


@dataclass(frozen=True, kw_only=True)
class ScreenFit:
    """Strength and convergence that fit a scene to a screen, for `Renderer`, and the depth that they give.

    Attributes:
        strength: Factor by which the baseline is multiplied.
        convergence_px: Disparity of the points that appear on the screen.
        front_percent: Parallax of the nearest points in percent of the width; negative if all of the scene is
            behind the screen.
        behind_percent: Parallax of the farthest points behind the screen, likewise.
        fits: Whether both are within the screen's budget.
    """

    strength: float
    convergence_px: float
    front_percent: float
    behind_percent: float
    fits: bool

    def describe(self) -> str:
        """Return the values in words, with negative depth in front of the screen."""
        return (
            f"strength {self.strength:.2f}, convergence {self.convergence_px:.1f} px, "
            f"depth {format_depth(self.front_percent, self.behind_percent)}"
        )


@dataclass(frozen=True, kw_only=True)
class ScreenChoice:
    """A screen, and what the caller decided about the views for it.

    Attributes:
        name: Name of the screen in `SCREENS`.
        strength: Strength as given; None to find it.
        convergence_px: Convergence as given; None to find it.
    """

    name: str
    strength: float | None = None
    convergence_px: float | None = None

    def __post_init__(self) -> None:
        find_screen(self.name)

    def fit(self, depth: Depth, width_px: int) -> ScreenFit:
        """Return strength and convergence for a scene in a picture of this width."""
        return fit_depth(
            depth, width_px, SCREENS[self.name], strength=self.strength, convergence_px=self.convergence_px
        )

    def describe(self, fit: ScreenFit) -> str:
        """Return a line that says what was chosen, what was given, and whether the depth is comfortable."""
        return f"{self.name}: {fit.describe()}{self.describe_rest(fits=fit.fits)}"

    def describe_rest(self, *, fits: bool) -> str:
        """Return what the line ends in: what was given, and the budget if the depth does not fit it."""
        given = {"strength": self.strength, "convergence": self.convergence_px}
        names = [name for name, value in given.items() if value is not None]
        parts = [f"; {' and '.join(names)} as given"] if names else []
        if not fits:
            screen = SCREENS[self.name]
            parts.append(
                f"; comfortable would be {format_depth(screen.front_percent, screen.behind_percent)}"
            )
        return "".join(parts)


def find_screen(name: str) -> Screen:
    """Return the screen of this name in `SCREENS`.

    Raises:
        StereoweaveError: There is no such screen.
    """
    check_kind("screen", name, str)
    check_choice("screen", name, SCREENS)
    return SCREENS[name]


def fit_screen(
    estimate: Estimate,
    screen: str,
    *,
    strength: float | None = None,
    convergence_px: float | None = None,
) -> ScreenFit:
    """Return strength and convergence with which a screen shows a pair without strain to the eyes.

    The strength is at most 1: a shallow scene is not exaggerated, because views from beyond the cameras show
    background that neither camera saw. Within the budget, the median disparity is on the screen.

    Args:
        estimate: The pair's estimate.
        screen: Name of the screen: phone, television, headset or light_field.
        strength: Strength to keep; default: the largest one that fits, at most 1.
        convergence_px: Convergence to keep; default: the one that fits.

    Raises:
        StereoweaveError: The screen is unknown, or a number is out of the range of `Renderer`.
    """
    check_kind("estimate", estimate, Estimate)
    width_px = estimate.disparity_px.shape[1]
    choice = ScreenChoice(
        name=screen,
        strength=None if strength is None else check_strength(strength),
        convergence_px=None if convergence_px is None else check_convergence_px(convergence_px, width_px),
    )
    return choice.fit(measure_any_depth(estimate), width_px)


def measure_depth(estimate: Estimate) -> Depth | None:
    """Return the disparities of a scene's confident pixels from the 1st to the 99th percentile.

    Occluded pixels do not count. None if there are too few confident ones, as in a black frame.
    """
    grid = find_grid(estimate)
    sure = (estimate.confidence[grid] >= CONFIDENT) & ~estimate.occluded[grid]
    if sure.mean() < _LEAST_CONFIDENT_SHARE:
        return None
    return _take_percentiles(estimate.disparity_px[grid][sure])


def measure_any_depth(estimate: Estimate) -> Depth:
    """Return the disparities of a scene as `measure_depth` does; of all pixels if too few are confident."""
    found = measure_depth(estimate)
    return found or _take_percentiles(estimate.disparity_px[find_grid(estimate)].ravel())


def fit_depth(
    depth: Depth,
    width_px: int,
    screen: Screen,
    *,
    strength: float | None = None,
    convergence_px: float | None = None,
) -> ScreenFit:
    """Return strength and convergence with which a screen shows these disparities; see `fit_screen`.

    If a given strength shows more depth than fits, what is too much is shared between front and back in
    proportion to the budget.
    """
    front_px, behind_px = (
        percent / 100 * width_px for percent in (screen.front_percent, screen.behind_percent)
    )
    if strength is None:
        strength = _find_strength(depth, (front_px, behind_px), convergence_px)
    if convergence_px is None:
        convergence_px = _find_convergence_px(depth, (front_px, behind_px), strength)
    strength, convergence_px = float(strength), float(np.clip(convergence_px, -width_px, width_px))
    front = strength * (depth.near_px - convergence_px)
    behind = strength * (convergence_px - depth.far_px)
    return ScreenFit(
        strength=strength,
        convergence_px=convergence_px,
        front_percent=100 * front / width_px,
        behind_percent=100 * behind / width_px,
        fits=front <= front_px + _ROUNDING_PX and behind <= behind_px + _ROUNDING_PX,
    )


def format_depth(front_percent: float, behind_percent: float) -> str:
    """Return a depth range in words; negative numbers are in front of the screen."""
    return f"{-front_percent:+z.1f} % to {behind_percent:+z.1f} % of the width"


def _find_strength(depth: Depth, budget_px: tuple[float, float], convergence_px: float | None) -> float:
    """Return the largest strength that fits, at most 1."""
    front_px, behind_px = budget_px
    if convergence_px is None:
        needed = [(sum(budget_px), depth.near_px - depth.far_px)]
    else:
        needed = [(front_px, depth.near_px - convergence_px), (behind_px, convergence_px - depth.far_px)]
    return float(min([1.0, *(most / shown for most, shown in needed if shown > 0)]))


def _find_convergence_px(depth: Depth, budget_px: tuple[float, float], strength: float) -> float:
    """Return the convergence nearest to the scene's median at which all fits; else one that shares."""
    front_px, behind_px = budget_px
    if strength == 0:
        return depth.middle_px
    least_px, most_px = depth.near_px - front_px / strength, depth.far_px + behind_px / strength
    if least_px <= most_px:
        return float(np.clip(depth.middle_px, least_px, most_px))
    return depth.far_px + (depth.near_px - depth.far_px) * behind_px / (front_px + behind_px)


def find_grid(estimate: Estimate) -> tuple[slice, slice]:
    """Return the rows and columns of a grid of about 40,000 pixels."""
    step = max(1, int((estimate.disparity_px.size / _SAMPLED_PIXELS) ** 0.5))
    return slice(step // 2, None, step), slice(step // 2, None, step)


def _take_percentiles(disparity_px: Float[np.ndarray, " n"]) -> Depth:
    far_px, middle_px, near_px = np.percentile(disparity_px, [_OUTER_PERCENT, 50, 100 - _OUTER_PERCENT])
    return Depth(float(near_px), float(far_px), float(middle_px))
