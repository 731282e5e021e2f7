"""Kinds of collages: mixed objects, textureless planes close to the camera, streets, and film shots."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereoweave.learn.data.collage_layers import (
    PLANE_SLOPE,
    draw_layer,
    draw_paint,
    draw_plain_paint,
    draw_plane,
    draw_unfocused_paint,
)
from stereoweave.learn.data.collage_scene import CollageLayer, CollageScene, CollageSurface
from stereoweave.learn.data.paint_kernels import Paint
from stereoweave.learn.data.silhouettes import (
    Patch,
    Placement,
    cover_below,
    cover_canvas,
    draw_board,
    draw_pillar,
    draw_polygon,
    draw_post,
    draw_rods,
    draw_shape,
    soften,
)

NETWORK_REACH_PX = 188  # largest disparity that a WeaveNet at the full resolution can find


@dataclass(frozen=True, kw_only=True)
class CollageCanvas:
    """The area in which layers are drawn.

    Its size follows from the size of the views and the largest disparity of the scene, both in px.
    """

    view_width: int
    height: int
    limit_px: float

    @property
    def width(self) -> int:
        """Number of columns, including those beyond the left view that only the right camera sees."""
        return self.view_width + int(np.ceil(self.limit_px)) + 2

    def whole(self) -> Placement:
        """Return the placement that covers the whole canvas."""
        return Placement(self.width / 2, self.height / 2, self.width / 2, self.width, self.height)

    def place(self, x: float, y: float, radius_px: float) -> Placement:
        """Return a placement at a point on the canvas."""
        return Placement(x, y, radius_px, self.width, self.height)

    def anywhere(self, rng: np.random.Generator, smallest: float, largest: float) -> Placement:
        """Draw a placement whose half extent is log-uniform between the given shares of the canvas width."""
        radius_px = self.width * float(np.exp(rng.uniform(np.log(smallest), np.log(largest))))
        return self.place(rng.uniform(0, self.width), rng.uniform(0, self.height), radius_px)

    def between(self, far_px: float, nearness: float) -> float:
        """Return the disparity for a nearness from 0 (`far_px`) to 1 (the scene's largest disparity)."""
        return far_px + (self.limit_px - far_px) * nearness


Kind = Callable[[np.random.Generator, CollageCanvas], list[CollageLayer]]


def draw_scene(rng: np.random.Generator, height: int, width: int) -> CollageScene:
    """Draw a mixed scene, as used for validation.

    For views 384 px wide, its largest disparity is log-uniform, usually from 10 to 110 px and otherwise from
    6 to 188 px.
    """
    low, high = (10, 110) if rng.random() < 0.7 else (6, 190)
    limit_px = float(np.exp(rng.uniform(np.log(low), np.log(high)))) * width / 384
    return _draw(rng, draw_mixed, height, width, min(limit_px, NETWORK_REACH_PX))


def draw_training_scene(rng: np.random.Generator, height: int, width: int) -> CollageScene:
    """Draw a scene of any kind, with a wider baseline than for validation.

    Its largest disparity is log-uniform, usually from 22 to 175 px and otherwise from 6 to 188 px. It is
    proportionally smaller in views that are less than 384 px wide.
    """
    low, high = (22, 175) if rng.random() < 0.7 else (6, NETWORK_REACH_PX)
    # Wider views show more of a scene, not larger disparities, because the network's range is limited.
    limit_px = float(np.exp(rng.uniform(np.log(low), np.log(high)))) * min(width / 384, 1)
    kind = list(KINDS)[rng.choice(len(KINDS), p=list(KINDS.values()))]
    return _draw(rng, kind, height, width, limit_px)


def _draw(rng: np.random.Generator, kind: Kind, height: int, width: int, limit_px: float) -> CollageScene:
    canvas = CollageCanvas(view_width=width, height=height, limit_px=limit_px)
    # Far to near, so that the nearer of two soft edges is blended last.
    layers = sorted(kind(rng, canvas), key=lambda layer: layer.surface.plane[0])
    return CollageScene(layers=tuple(layers), height=height, width=width)


def draw_mixed(rng: np.random.Generator, canvas: CollageCanvas) -> list[CollageLayer]:
    """Draw one or two backgrounds, objects and, in half of the scenes, bunches of rods."""
    far_px = rng.uniform(0, 1) if rng.random() < 0.1 else canvas.limit_px * rng.uniform(0.08, 0.5)
    layers = _draw_backgrounds(rng, canvas, far_px)
    bunches = int(rng.integers(1, 5)) if rng.random() < 0.5 else 0
    for k in range(rng.integers(6, 25)):
        thin = k < bunches
        place = canvas.anywhere(rng, 0.07 if thin else 0.012, 0.6)
        # Large objects tend to be in the back and rods in front, so that little is occluded.
        nearness = rng.random() ** (0.8 if thin else 1 + 3 * place.radius_px / canvas.view_width)
        patch = draw_rods(rng, place) if thin else draw_shape(rng, place)
        layers.append(draw_layer(rng, patch, place, canvas.between(far_px, nearness), canvas.limit_px))
    return layers


def _draw_backgrounds(rng: np.random.Generator, canvas: CollageCanvas, far_px: float) -> list[CollageLayer]:
    layers = [draw_layer(rng, _cover_canvas(canvas), canvas.whole(), far_px, canvas.limit_px)]
    if rng.random() < 0.5:
        layers.append(_draw_floor(rng, canvas, far_px, 0.3, draw_paint))
    return layers


def _draw_floor(
    rng: np.random.Generator,
    canvas: CollageCanvas,
    start_px: float,
    least_rise: float,
    paint: Callable[[np.random.Generator, Placement], Paint],
) -> CollageLayer:
    """Draw a floor whose disparity is `start_px` at the horizon.

    Its disparity increases towards the bottom by a random share of the remaining range.
    """
    horizon, tilt = rng.uniform(0.3, 0.8) * canvas.height, rng.normal(0, 0.1)
    # The floor's disparity is constant along the horizon.
    rise = rng.uniform(least_rise, 1.0) * (canvas.limit_px - start_px) / (canvas.height - horizon)
    slope, middle_x = min(rise, PLANE_SLOPE), canvas.width / 2
    return CollageLayer(
        patch=cover_below(horizon - tilt * middle_x, tilt, canvas.width, canvas.height),
        surface=CollageSurface(
            plane=(start_px, -tilt * slope, slope, middle_x, horizon), limit_px=canvas.limit_px
        ),
        paint=paint(rng, canvas.whole()),
    )


def draw_boards(rng: np.random.Generator, canvas: CollageCanvas) -> list[CollageLayer]:
    """Draw textureless planes, close to the camera and larger than a crop, with objects around them."""
    far_px = canvas.limit_px * rng.uniform(0.05, 0.4)
    layers = _draw_backgrounds(rng, canvas, far_px)
    for _ in range(rng.integers(2, 9)):
        place = canvas.anywhere(rng, 0.03, 0.4)
        level_px = canvas.between(far_px, 0.4 * rng.random())
        layers.append(draw_layer(rng, draw_shape(rng, place), place, level_px, canvas.limit_px))
    for _ in range(1 if rng.random() < 0.7 else 2):
        plain = _draw_plain_plane(rng, canvas, far_px)
        layers += [plain, *_draw_attached(rng, canvas, plain), *_draw_objects_before(rng, canvas, plain)]
    return layers


def _draw_plain_plane(rng: np.random.Generator, canvas: CollageCanvas, far_px: float) -> CollageLayer:
    """Draw a plain board, table or wall, with probabilities of 1/2, 1/4 and 1/4."""
    kind = rng.random()
    if kind < 0.25:
        return _draw_floor(rng, canvas, canvas.between(far_px, rng.uniform(0.1, 0.6)), 0.5, draw_plain_paint)
    level_px = canvas.between(far_px, rng.uniform(0.25, 0.85))
    place = canvas.whole()
    patch = _cover_canvas(canvas)
    if kind < 0.75:
        place = canvas.anywhere(rng, 0.3, 0.8)
        patch = draw_board(rng, place)
    surface = draw_plane(rng, place, level_px, canvas.limit_px)
    return CollageLayer(patch=patch, surface=surface, paint=draw_plain_paint(rng, place))


def _draw_attached(
    rng: np.random.Generator, canvas: CollageCanvas, plain: CollageLayer
) -> list[CollageLayer]:
    """Draw objects on the plane's surface in half of the scenes, and none in the others."""
    count = rng.integers(1, 4) if rng.random() < 0.5 else 0
    places = [canvas.anywhere(rng, 0.015, 0.1) for _ in range(count)]
    return [
        CollageLayer(patch=draw_shape(rng, p), surface=plain.surface, paint=draw_paint(rng, p))
        for p in places
    ]


def _draw_objects_before(
    rng: np.random.Generator, canvas: CollageCanvas, plain: CollageLayer
) -> list[CollageLayer]:
    """Draw objects on or in front of the plane and, in half of the scenes, a pillar that splits it."""
    places = [canvas.anywhere(rng, 0.02, 0.2) for _ in range(rng.integers(1, 6))]
    patches = [draw_shape(rng, place) for place in places]
    if rng.random() < 0.5:
        places.append(canvas.anywhere(rng, 0.01, 0.08))
        patches.append(draw_pillar(rng, places[-1]))
    layers = []
    for place, patch in zip(places, patches, strict=True):
        # The plane's disparity at the object's foot.
        behind_px = plain.surface.plane_px(place.x, place.y + 0.8 * place.radius_px)
        level_px = canvas.between(behind_px, rng.random() ** 2)
        layers.append(draw_layer(rng, patch, place, level_px, canvas.limit_px))
    return layers


def draw_street(rng: np.random.Generator, canvas: CollageCanvas) -> list[CollageLayer]:
    """Draw a ground plane that reaches from the horizon to the camera, upright objects on it, and a sky."""
    horizon = rng.uniform(0.3, 0.6) * canvas.height
    rise = rng.uniform(0.5, 1.0) * canvas.limit_px / (canvas.height - horizon)
    middle_x = rng.uniform(0.25, 0.6) * canvas.width
    plane = (rng.uniform(0, 0.02) * canvas.limit_px, 0.0, rise, middle_x, horizon)
    ground = CollageSurface(plane=plane, limit_px=canvas.limit_px)
    layers = [_draw_sky(rng, canvas), _draw_ground(rng, canvas, ground), *_draw_markings(rng, canvas, ground)]
    for _ in range(rng.integers(0, 5)):
        layers.append(_draw_upright(rng, canvas, ground, rng.uniform(0.01, 0.08), rng.uniform(2, 15)))
    for side in (-1, 1):
        if rng.random() < 0.5:
            layers.append(_draw_facade(rng, canvas, ground, side))
    for _ in range(rng.integers(3, 13)):
        layers.append(_draw_upright(rng, canvas, ground, rng.uniform(0.1, 0.95), rng.uniform(0.5, 2.5)))
    return layers


def _draw_sky(rng: np.random.Generator, canvas: CollageCanvas) -> CollageLayer:
    """Draw a sky, which has clouds in two fifths of the streets and is textureless in the others."""
    bright = rng.uniform(120, 245) * np.array([rng.uniform(0.6, 1), rng.uniform(0.8, 1), 1.0])
    clouded = rng.random() < 0.4
    paint = (
        draw_unfocused_paint(rng, canvas.whole())
        if clouded
        else draw_plain_paint(rng, canvas.whole(), bright)
    )
    surface = CollageSurface(plane=(0.0, 0.0, 0.0, 0.0, 0.0), limit_px=canvas.limit_px)
    return CollageLayer(patch=_cover_canvas(canvas), surface=surface, paint=paint)


def _draw_ground(rng: np.random.Generator, canvas: CollageCanvas, ground: CollageSurface) -> CollageLayer:
    paint = draw_plain_paint(rng, canvas.whole()) if rng.random() < 0.3 else draw_paint(rng, canvas.whole())
    return CollageLayer(
        patch=cover_below(ground.plane[4], 0.0, canvas.width, canvas.height), surface=ground, paint=paint
    )


def _draw_markings(
    rng: np.random.Generator, canvas: CollageCanvas, ground: CollageSurface
) -> list[CollageLayer]:
    """Draw solid or dashed strips on the ground that converge at a vanishing point."""
    middle_x, horizon = ground.plane[3:]
    layers = []
    for _ in range(rng.integers(0, 5)):
        foot_x, width = rng.uniform(-0.5, 1.5) * canvas.width, rng.uniform(0.01, 0.08) * canvas.width
        colour = rng.uniform(150, 250) * np.array([1.0, rng.uniform(0.8, 1), rng.uniform(0.3, 1)])
        paint = draw_plain_paint(rng, canvas.whole(), colour)
        # Dashes of equal length shrink as 1 / depth towards the horizon.
        ends = 1 / np.arange(1.0, 1 + rng.integers(1, 9), rng.uniform(0.4, 1.0))
        for near, far in zip(ends[::2], [*ends[1::2], 0.02], strict=False):
            sides = [(foot_x, near), (foot_x + width, near), (foot_x + width, far), (foot_x, far)]
            corners = [
                (middle_x + (x - middle_x) * t, horizon + (canvas.height - horizon) * t) for x, t in sides
            ]
            patch = draw_polygon(np.array(corners), canvas.whole())
            layers.append(CollageLayer(patch=patch, surface=ground, paint=paint))
    return layers


def _draw_upright(
    rng: np.random.Generator, canvas: CollageCanvas, ground: CollageSurface, nearness: float, tallness: float
) -> CollageLayer:
    """Draw an upright object on the ground; `tallness` is its height as a multiple of the camera's."""
    horizon = ground.plane[4]
    height = nearness * (canvas.height - horizon)
    foot_x, foot_y = rng.uniform(0, canvas.width), horizon + height
    radius_px = max(tallness * height / 2, 3.0)
    place = canvas.place(foot_x, foot_y - 0.8 * radius_px, radius_px)
    level_px = ground.plane_px(foot_x, foot_y)
    thin = rng.random() < 0.25
    patch = draw_post(place, max(0.6, 0.04 * height), foot_y) if thin else draw_shape(rng, place)
    return CollageLayer(
        patch=patch,
        surface=CollageSurface(plane=(level_px, 0.0, 0.0, place.x, foot_y), limit_px=canvas.limit_px),
        paint=draw_paint(rng, place),
    )


def _draw_facade(
    rng: np.random.Generator, canvas: CollageCanvas, ground: CollageSurface, side: int
) -> CollageLayer:
    """Draw a wall on the ground along the left (-1) or right (1) side of the street."""
    start_px, _, rise, middle_x, horizon = ground.plane
    slope = rng.uniform(0.2, 1.0) * min(PLANE_SLOPE, 2 * canvas.limit_px / canvas.width)
    foot, roof = slope / rise, slope / rise * rng.uniform(1, 4)
    near, far = canvas.width, rng.uniform(0.02, 0.3) * canvas.width
    corners = [
        (middle_x + side * far, horizon + foot * far),
        (middle_x + side * near, horizon + foot * near),
        (middle_x + side * near, horizon - roof * near),
        (middle_x + side * far, horizon - roof * far),
    ]
    plane = (start_px, side * slope, 0.0, middle_x, horizon)
    return CollageLayer(
        patch=draw_polygon(np.array(corners), canvas.whole()),
        surface=CollageSurface(plane=plane, limit_px=canvas.limit_px),
        paint=draw_paint(rng, canvas.whole()),
    )


def draw_film(rng: np.random.Generator, canvas: CollageCanvas) -> list[CollageLayer]:
    """Draw figures in focus, far in front of an out-of-focus background.

    In a third of the scenes, an out-of-focus object is close to the camera.
    """
    far_px = canvas.limit_px * rng.uniform(0.02, 0.25)
    layers = [_draw_unfocused(rng, canvas, _cover_canvas(canvas), canvas.whole(), far_px)]
    for _ in range(rng.integers(1, 5)):
        place = canvas.anywhere(rng, 0.08, 0.4)
        level_px = canvas.between(far_px, rng.uniform(0.05, 0.35))
        layers.append(_draw_unfocused(rng, canvas, soften(draw_shape(rng, place)), place, level_px))
    for _ in range(rng.integers(1, 4)):
        layers += _draw_figure(rng, canvas, canvas.between(far_px, rng.uniform(0.45, 0.9)))
    if rng.random() < 0.35:
        place, level_px = canvas.anywhere(rng, 0.2, 0.5), canvas.between(far_px, rng.uniform(0.85, 1))
        layers.append(_draw_unfocused(rng, canvas, soften(draw_shape(rng, place)), place, level_px))
    return layers


def _draw_unfocused(
    rng: np.random.Generator, canvas: CollageCanvas, patch: Patch, place: Placement, level_px: float
) -> CollageLayer:
    surface = draw_plane(rng, place, level_px, canvas.limit_px)
    return CollageLayer(patch=patch, surface=surface, paint=draw_unfocused_paint(rng, place))


def _draw_figure(rng: np.random.Generator, canvas: CollageCanvas, level_px: float) -> list[CollageLayer]:
    """Draw a large, usually plain object with a few details on its surface."""
    place = canvas.anywhere(rng, 0.12, 0.4)
    smooth = rng.random() < 0.6
    body = draw_layer(rng, draw_shape(rng, place), place, level_px, canvas.limit_px)
    if smooth:
        body = CollageLayer(patch=body.patch, surface=body.surface, paint=draw_plain_paint(rng, place))
    details = []
    for _ in range(rng.integers(0, 6)):
        x, y = rng.normal([place.x, place.y], place.radius_px / 3)
        spot = canvas.place(x, y, place.radius_px * rng.uniform(0.03, 0.2))
        paint = draw_paint(rng, spot)
        details.append(CollageLayer(patch=draw_shape(rng, spot), surface=body.surface, paint=paint))
    return [body, *details]


def _cover_canvas(canvas: CollageCanvas) -> Patch:
    return cover_canvas(canvas.width, canvas.height)


# Share of each kind in training.
KINDS: dict[Kind, float] = {
    draw_mixed: 0.6,
    draw_boards: 0.2,
    draw_street: 0.1,
    draw_film: 0.1,
}
