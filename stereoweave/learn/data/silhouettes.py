"""Silhouettes of the layers in a collage, as patches of signed distances in the left image."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.learn.data.paint_kernels import REACH_PX, draw_outline_field, draw_stroke_field

MARGIN_PX = 3  # around a silhouette, so that the edge of its patch is clearly outside

Points = Float[np.ndarray, "_ 2"]
Strokes = tuple[tuple[Points, float], ...]


@dataclass(frozen=True)
class Patch:
    """Signed distances in px to a silhouette, float32 [h, w], positive inside.

    The patch starts at column `left` and row `top` of the left image.
    """

    field: Float[np.ndarray, "h w"]
    left: int
    top: int


@dataclass(frozen=True)
class Placement:
    """Centre and half extent of a silhouette in px, and the size of the canvas that clips it."""

    x: float
    y: float
    radius_px: float
    width: int
    height: int

    def ring(self, angles: Float[np.ndarray, " n"], radii: Float[np.ndarray, " n"]) -> Points:
        """Return points around the centre, at the given angles and multiples of the half extent."""
        reach = self.radius_px * radii
        return np.stack([self.x + reach * np.cos(angles), self.y + reach * np.sin(angles)], axis=1)

    def box(self, points: Points, margin_px: float) -> tuple[int, int, tuple[int, int]]:
        """Return the points' bounding box on the canvas as left, top and (height, width); it may be empty."""
        canvas = [self.width, self.height]
        low = np.clip(np.floor(points.min(axis=0) - margin_px), 0, canvas).astype(int)
        high = np.clip(np.ceil(points.max(axis=0) + margin_px) + 1, low, canvas).astype(int)
        return int(low[0]), int(low[1]), (int(high[1] - low[1]), int(high[0] - low[0]))


def draw_shape(rng: np.random.Generator, place: Placement) -> Patch:
    """Draw a silhouette of a random kind."""
    kinds = list(SHAPES)
    return SHAPES[kinds[rng.integers(len(kinds))]](rng, place)


def cover_canvas(width: int, height: int) -> Patch:
    """Return a patch that covers the whole canvas."""
    return Patch(np.full((height, width), REACH_PX, np.float32), 0, 0)


def cover_below(line_y: float, tilt: float, width: int, height: int) -> Patch:
    """Return a patch that covers the canvas below a line, which starts at row `line_y` at the left edge."""
    distance = np.arange(height)[:, None] - (line_y + tilt * np.arange(width)[None])
    return Patch(np.clip(distance, -REACH_PX, REACH_PX).astype(np.float32), 0, 0)


def draw_rods(rng: np.random.Generator, place: Placement) -> Patch:
    """Draw a bunch of rods 1 to 6 px wide: parallel bars, a star of branches, or sagging wires."""
    kind = rng.integers(3)
    lean = rng.uniform(0, np.pi)
    strokes = []
    for _ in range(rng.integers(1, 11)):
        angle = lean + (rng.normal(0, 0.06) if kind == 0 else rng.uniform(-1.2, 1.2) if kind == 1 else 0.0)
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        foot = [place.x, place.y] + across * rng.uniform(-1, 1) * place.radius_px * (kind != 1)
        t = np.linspace(-1, 1, 9)[:, None] if kind != 1 else np.linspace(0, 1, 7)[:, None]
        sag = rng.normal(0, 0.15) * (kind != 0 or rng.random() < 0.2)
        points = foot + place.radius_px * (t * along + sag * t * t * across)
        strokes.append((points, float(np.exp(rng.uniform(0, np.log(6))) / 2)))
    return _fill_strokes(tuple(strokes), place)


def draw_board(rng: np.random.Generator, place: Placement) -> Patch:
    """Draw a rectangle in perspective, usually upright, with the placement's half extent as half width."""
    turn = rng.normal(0, 0.06) if rng.random() < 0.8 else rng.uniform(0, np.pi)
    half_height = rng.uniform(0.4, 1.1)
    corners = np.array([[-1, -half_height], [1, -half_height], [1, half_height], [-1, half_height]])
    # The farther side is shorter.
    corners[:, 1] *= 1 + rng.uniform(-0.15, 0.15) * corners[:, 0]
    turned = corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return draw_polygon([place.x, place.y] + place.radius_px * turned, place)


def draw_pillar(rng: np.random.Generator, place: Placement) -> Patch:
    """Draw a bar across the canvas, usually upright, with the placement's half extent as half width."""
    turn = np.pi / 2 + rng.normal(0, 0.05) if rng.random() < 0.8 else rng.uniform(0, np.pi)
    reach = np.hypot(place.width, place.height) + place.radius_px
    along = reach * np.array([np.cos(turn), np.sin(turn)])
    across = place.radius_px * np.array([-np.sin(turn), np.cos(turn)])
    corners = np.stack([along + across, across - along, -along - across, along - across])
    return draw_polygon([place.x, place.y] + corners, place)


def draw_post(place: Placement, half_width_px: float, foot_y: float) -> Patch:
    """Draw an upright stroke from the placement's top down to row `foot_y`."""
    points = np.array([[place.x, place.y - place.radius_px], [place.x, foot_y]])
    return _fill_strokes(((points, half_width_px),), place)


def draw_polygon(corners: Points, place: Placement) -> Patch:
    """Fill a polygon, clipped to the placement's canvas."""
    return _fill_outline(place, corners)


def soften(patch: Patch) -> Patch:
    """Soften the patch's edges to a width of 4 px, as if out of focus; its interior stays opaque."""
    return Patch(patch.field * np.float32(0.5 / REACH_PX), patch.left, patch.top)


def _fill_outline(place: Placement, *contours: Points) -> Patch:
    left, top, shape = place.box(np.concatenate(contours), MARGIN_PX)
    return Patch(draw_outline_field(contours, left, top, shape), left, top)


def _fill_strokes(strokes: Strokes, place: Placement) -> Patch:
    thickest = max(half_width_px for _, half_width_px in strokes)
    left, top, shape = place.box(np.concatenate([points for points, _ in strokes]), thickest + MARGIN_PX)
    return Patch(draw_stroke_field(strokes, left, top, shape), left, top)


def _ellipse_points(rng: np.random.Generator, place: Placement, scale: float = 1.0) -> Points:
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    slim, turn = rng.uniform(0.35, 1), rng.uniform(0, np.pi)
    radii = scale * slim / np.sqrt((slim * np.cos(angles)) ** 2 + np.sin(angles) ** 2)
    return place.ring(angles + turn, radii)


def _draw_ellipse(rng: np.random.Generator, place: Placement) -> Patch:
    return _fill_outline(place, _ellipse_points(rng, place))


def _draw_ring(rng: np.random.Generator, place: Placement) -> Patch:
    points = _ellipse_points(rng, place)
    centre = np.array([place.x, place.y])
    return _fill_outline(place, points, centre + rng.uniform(0.4, 0.85) * (points - centre))


def _draw_random_polygon(rng: np.random.Generator, place: Placement) -> Patch:
    angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
    return _fill_outline(place, place.ring(angles, np.ones(len(angles))))


def _draw_jagged(rng: np.random.Generator, place: Placement) -> Patch:
    angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(6, 16)))
    return _fill_outline(place, place.ring(angles, rng.uniform(0.3, 1, len(angles))))


def _draw_blob(rng: np.random.Generator, place: Placement) -> Patch:
    angles = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    waves = np.arange(2, 7)
    strength = rng.normal(0, 0.35, len(waves)) / waves
    phases = rng.uniform(0, 2 * np.pi, len(waves))
    radii = 0.75 + np.sin(angles[:, None] * waves + phases) @ strength
    return _fill_outline(place, place.ring(angles, np.maximum(radii, 0.15)))


def _draw_rectangle(rng: np.random.Generator, place: Placement) -> Patch:
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    # A superellipse: larger powers give sharper corners.
    power, slim = np.exp(rng.uniform(np.log(4), np.log(40))), rng.uniform(0.25, 1)
    cosine, sine = np.cos(angles), np.sin(angles)
    radii = 0.8 / (np.abs(cosine) ** power + np.abs(sine / slim) ** power) ** (1 / power)
    turn = rng.normal(0, 0.08) if rng.random() < 0.6 else rng.uniform(0, np.pi)
    return _fill_outline(place, place.ring(angles + turn, radii))


def _draw_foliage(rng: np.random.Generator, place: Placement) -> Patch:
    around = place.ring(np.arange(4) * np.pi / 2, np.ones(4))
    left, top, (height, width) = place.box(around, 0)
    if height == 0 or width == 0:
        return Patch(np.full((height, width), -REACH_PX, np.float32), left, top)
    leaf_px = max(3.0, rng.uniform(0.1, 0.5) * place.radius_px)
    coarse = rng.standard_normal((int(height / leaf_px) + 3, int(width / leaf_px) + 3), np.float32)
    fine = rng.standard_normal((coarse.shape[0] * 2, coarse.shape[1] * 2), np.float32)
    noise = _enlarge(coarse, width, height) + 0.4 * _enlarge(fine, width, height)
    y, x = np.ogrid[top : top + height, left : left + width]
    fall = np.hypot(x - place.x, y - place.y) / place.radius_px
    # The noise changes by about 1 across a leaf; multiplied by the leaf's size, it approximates a distance.
    field = (noise + 2.5 * (rng.uniform(0.5, 0.8) - fall)) * (0.7 * leaf_px)
    inside = np.minimum(field, (1 - fall) * place.radius_px - 1)
    return Patch(np.clip(inside, -REACH_PX, REACH_PX).astype(np.float32), left, top)


def _enlarge(noise: Float[np.ndarray, "_ _"], width: int, height: int) -> Float[np.ndarray, "_ _"]:
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def _draw_marks(rng: np.random.Generator, place: Placement) -> Patch:
    """Draw a row of strokes that resembles lettering."""
    count = int(rng.integers(2, 9))
    size = 2 * place.radius_px / count
    half_width_px = float(max(0.6, size * rng.uniform(0.05, 0.12)))
    strokes = []
    for k in range(count):
        corner = [place.x - place.radius_px + k * size, place.y - size / 2]
        points = corner + rng.random((rng.integers(3, 6), 2)) * [0.8 * size, 1.2 * size]
        strokes.append((points, half_width_px))
    return _fill_strokes(tuple(strokes), place)


SHAPES: dict[str, Callable[[np.random.Generator, Placement], Patch]] = {
    "ellipse": _draw_ellipse,
    "ring": _draw_ring,
    "polygon": _draw_random_polygon,
    "jagged": _draw_jagged,
    "blob": _draw_blob,
    "rectangle": _draw_rectangle,
    "foliage": _draw_foliage,
    "marks": _draw_marks,
}
