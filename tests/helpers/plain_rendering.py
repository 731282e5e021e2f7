"""Plain NumPy reference of the renderer, which processes whole views at once and splats pixel by pixel."""

from typing import NamedTuple

import numpy as np

SAME_SURFACE_PX = 3.0


class PlainSide(NamedTuple):
    image: np.ndarray
    disparity_px: np.ndarray
    shift: float
    nearness: float
    offset_px: float

    def column(self, d):
        """Return the column in the image of each pixel of the new view, at disparity d."""
        return np.arange(d.shape[1]) - self.offset_px - self.shift * d


def plain_rendering(left, right, estimate, position, convergence_px=0.0):
    """Render image and mask like `stereoweave.render`, and the mask of pure colours.

    Positions 0 and 1 are not supported. Beyond the cameras the renderer fills impure pixels differently; here
    they are filled as between the cameras.
    """
    near, far = abs(1 - position) ** 0.5, abs(position) ** 0.5
    offset_px = (position - 0.5) * convergence_px
    sides = (
        PlainSide(
            left.astype(float), estimate.disparity_px.astype(float), -position, near / (near + far), offset_px
        ),
        PlainSide(
            right.astype(float),
            estimate.right_disparity_px.astype(float),
            1 - position,
            far / (near + far),
            offset_px,
        ),
    )
    front, back, share = plain_surfaces(sides, estimate.confidence)
    supports = [support(side, np.nan_to_num(front), purity(side)) for side in sides]
    front = aligned(sides, front, back)
    image, seen, pure = plain_colours(sides, front, back, share, supports)
    nearest = left if position < 0.5 else right
    image = np.where(np.isnan(seen)[..., None], nearest, image)
    image = np.floor(np.clip(image, 0, 255) + 0.5)
    return *plain_fill(image, seen, pure), pure


def plain_splat(disparity_px, shift, offset_px=0.0):
    """Return the nearest disparity on each pixel of the new view; NaN if there is none."""
    landed = np.full(disparity_px.shape, np.nan)
    columns = np.arange(disparity_px.shape[1])
    for line, row in zip(landed, disparity_px, strict=True):
        u = columns + shift * row + offset_px
        joined = np.abs(np.diff(row)) <= SAME_SURFACE_PX
        for x in range(len(row)):
            on_left = (columns >= u[x] - 0.5) & (columns <= u[x])
            on_right = (columns >= u[x]) & (columns < u[x] + 0.5)
            covered = columns == u[x]
            if x == 0 or not joined[x - 1]:
                covered = covered | on_left
            if x == len(row) - 1 or not joined[x]:
                covered = covered | on_right
            line[covered] = np.fmax(line[covered], row[x])
        for x in np.flatnonzero(joined & (u[1:] > u[:-1])):
            between = (columns >= u[x]) & (columns <= u[x + 1])
            line[between] = np.fmax(line[between], np.interp(columns[between], u[x : x + 2], row[x : x + 2]))
    return landed


def tap(values, column):
    """Return `values` [H, W, ...] at integer columns [H, W]; the border repeats."""
    return values[np.arange(len(values))[:, None], np.clip(column, 0, values.shape[1] - 1)]


def linear(values, column):
    whole = np.floor(column).astype(int)
    part = (column - whole).reshape(column.shape + (1,) * (values.ndim - 2))
    return (1 - part) * tap(values, whole) + part * tap(values, whole + 1)


def cubic(values, column):
    """Interpolate by the textbook Catmull-Rom spline through the four neighbours; the border repeats."""
    column = np.clip(column, 0, values.shape[1] - 1)
    whole = np.floor(column).astype(int)
    t = (column - whole)[..., None]
    a, b, c, d = (tap(values, whole + k) for k in (-1, 0, 1, 2))
    return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))


def inside(side, column):
    return (column >= 0) & (column <= side.disparity_px.shape[1] - 1)


def purity(side):
    """Return 1, or down to 0.1 where one of the 8 neighbours is nearer by 1 to 2 px of the new view."""
    padded = np.pad(side.disparity_px, 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return np.clip(2 - abs(side.shift) * (windows.max((2, 3)) - side.disparity_px), 0.1, 1)


def support(side, d, weight):
    """Return the support of each pixel's surface d in the image; weight [H, W] is per pixel of the image."""
    column = side.column(d)
    whole = np.floor(column).astype(int)
    parts = [
        tap(weight, whole + k)
        * np.clip(1 + (SAME_SURFACE_PX - np.abs(tap(side.disparity_px, whole + k) - d)) / 2, 0, 1)
        for k in (0, 1)
    ]
    width = side.disparity_px.shape[1]
    shown = (column >= -0.5) & (column <= width - 0.5)
    return shown * (parts[0] + (column - whole) * (parts[1] - parts[0]))


def gap(side, d):
    column = side.column(d)
    whole = np.floor(column).astype(int)
    before, after = (tap(side.disparity_px, whole + k) - d for k in (0, 1))
    return inside(side, column) * np.where(np.abs(before) < np.abs(after), before, after)


def mismatch(sides, d):
    """Return the difference of both images over three columns at disparity d; NaN if none is inside both."""
    total, count = np.zeros(d.shape), np.zeros(d.shape)
    for k in (-1, 0, 1):
        left, right = (side.column(d) + k for side in sides)
        both = inside(sides[0], left) & inside(sides[1], right)
        apart = np.abs(linear(sides[0].image, left) - linear(sides[1].image, right)).sum(2)
        total += np.where(both, apart, 0)
        count += both
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def share_of_left(sides, confidence, a, b):
    """Return the share of surface a where a and b are two surfaces; both are finite."""
    left, right = sides
    gap_a, gap_b = gap(right, a), gap(left, b)
    trust_a, trust_b = linear(confidence, left.column(a)), linear(confidence, left.column(b))
    trust_b = np.select([gap_b > SAME_SURFACE_PX, gap_b < -SAME_SURFACE_PX], [0.5, 1 - trust_b], trust_b)
    levels = np.array([mismatch(sides, a), mismatch(sides, b)])
    levels = np.where(np.isnan(levels).any(0), 0, levels)
    weights = [sum(s.nearness * support(s, d, purity(s)) for s in sides) for d in (a, b)]
    scores = np.array([(0.3 + trust_a) * weights[0], (0.3 + trust_b) * weights[1]]) / (10 + levels)
    share = np.where(scores[0] > 0, scores[0] / np.maximum(scores.sum(0), 1e-300), 0)
    share[(a > b) & (gap_a >= -SAME_SURFACE_PX)] = 1
    share[(b > a) & (gap_b >= -SAME_SURFACE_PX)] = 0
    return share


def plain_surfaces(sides, confidence):
    """Return front and back disparity of the new view's pixels (NaN: none), and the front's share."""
    a, b = (plain_splat(side.disparity_px, side.shift, side.offset_px) for side in sides)
    both = np.isfinite(a) & np.isfinite(b)
    same = both & (np.abs(a - b) <= SAME_SURFACE_PX)
    front = np.where(same, (a + b) / 2, np.fmax(a, b))
    share = np.where(both & ~same, share_of_left(sides, confidence, np.nan_to_num(a), np.nan_to_num(b)), 1.0)
    front = np.where(both & ~same, np.where(share > 0, a, b), front)
    back = np.where((share > 0) & (share < 1), b, np.nan)
    share[share == 0] = 1
    nearest = np.pad(np.fmax(a, b), ((0, 0), (1, 1)), constant_values=np.nan)
    beside = np.fmax(nearest[:, :-2], nearest[:, 2:])
    edge = np.isnan(back) & (beside > front + SAME_SURFACE_PX)
    ones = np.ones(a.shape)
    covered = sum(side.nearness * support(side, np.nan_to_num(beside), ones) for side in sides)
    edge &= covered > 0
    return (
        np.where(edge, beside, front),
        np.where(edge, front, back),
        np.where(edge, covered, share),
    )


def aligned(sides, front, back):
    """Return `front` after one least-squares step over windows of 5x5 pixels."""
    d = np.nan_to_num(front)
    greys = [grey(side.image) for side in sides]
    seen = np.min([support(side, d, purity(side)) for side in sides], axis=0) >= 0.5
    seen &= np.isfinite(front) & np.isnan(back)
    left, right = (side.column(d) for side in sides)
    left, right = (np.clip(x, 0, d.shape[1] - 1) for x in (left, right))
    difference = linear(greys[0], left) - linear(greys[1], right)
    slope = sum(
        sign * side.shift * (linear(g, x + 1) - linear(g, x - 1)) / 2
        for sign, side, g, x in ((-1, sides[0], greys[0], left), (1, sides[1], greys[1], right))
    )
    along, square, count = (
        windows(np.where(seen, values, 0)) for values in (difference * slope, slope**2, np.ones(d.shape))
    )
    step = np.clip(-along / (square + 30 * np.maximum(count, 1)), -1, 1)
    return np.where(seen, front + step, front)


def grey(image):
    """Return ITU-R BT.601 luma as integers, with OpenCV's fixed-point weights."""
    return (image.astype(int) @ [9798, 19235, 3735] + 2**14) >> 15


def windows(values):
    padded = np.pad(values, 2)
    return np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).sum((2, 3))


def plain_colours(sides, front, back, share, front_supports):
    """Return colours, disparity of the surface with the greatest share (NaN: none), mask of pure colours."""
    colours, known, seen_by = [], [], []
    back_supports = [support(side, np.nan_to_num(back), purity(side)) for side in sides]
    layers = (front, share, front_supports), (back, 1 - share, back_supports)
    for layer, (surface, part, found) in enumerate(layers):
        exists, d = np.isfinite(surface), np.nan_to_num(surface)
        supports = [exists * of_side for of_side in found]
        weights = [side.nearness * s for side, s in zip(sides, supports, strict=True)]
        of_left = weights[0] / np.maximum(sum(weights), 1e-300)
        seen_in = [cubic(side.image, side.column(d)) for side in sides]
        if layer == 0:
            both = (np.minimum(*supports) >= 0.5) & np.isnan(back)
            of_left = part_doubles(of_left, *seen_in, d, both)
        colours.append(of_left[..., None] * seen_in[0] + (1 - of_left)[..., None] * seen_in[1])
        known.append(np.where(sum(supports) > 0, part, 0))
        seen_by.append(sum(supports))
    total = known[0] + known[1]
    image = sum(k[..., None] * c for k, c in zip(known, colours, strict=True))
    image = image / np.where(total > 0, total, 1)[..., None]
    of_front = known[0] >= known[1]
    seen = np.where(of_front, front, back)
    seen[total == 0] = np.nan
    return image, seen, (total > 0) & (np.where(of_front, seen_by[0], seen_by[1]) > 0.15)


def part_doubles(of_left, left, right, d, both):
    """Return the left image's share, 0 or 1 where one image shows a thin structure missing from the maps."""
    of_left = of_left.copy()
    agreed = both & (np.abs(left - right).sum(2) <= 30)
    for y, x in np.argwhere(both & ~agreed):
        places = np.flatnonzero(agreed[y])
        before, after = places[places < x][-1:], places[places > x][:1]
        if not (len(before) and len(after) and max(x - before[0], after[0] - x) <= 12):
            continue
        a, b = before[0], after[0]
        flat = max(abs(d[y, a] - d[y, x]), abs(d[y, b] - d[y, x])) <= SAME_SURFACE_PX
        if flat and np.abs(left[y, a] - left[y, b]).sum() <= 20:
            of_one, of_other = (np.abs(colours[y, x] - left[y, a]).sum() for colours in (left, right))
            if min(of_one, of_other) <= 20 and max(of_one, of_other) >= 60:
                of_left[y, x] = of_one < of_other
    return of_left


def plain_fill(image, seen, pure):
    """Fill impure pixels from beyond the farther end of their run; return the image and the drawn mask.

    A narrow run gets the mean colour there. A wide run mirrors the pixels there that are on the same surface.
    """
    height, width = pure.shape
    filled, drawn = image.copy(), np.isfinite(seen)
    for y in range(height):
        known = np.flatnonzero(pure[y])
        for x in np.flatnonzero(~pure[y]):
            before, after = known[known < x][-1:], known[known > x][:1]
            ends = [(end, -1) for end in before] + [(end, 1) for end in after]
            if not ends:
                continue
            source, inwards = min(ends, key=lambda end: seen[y, end[0]])
            if drawn[y, x] and seen[y, x] < seen[y, source] - SAME_SURFACE_PX:
                continue
            narrow = len(ends) == 2 and after[0] - before[0] - 1 <= 8
            mirrored = min(max(2 * source - x, 0), width - 1)
            same = pure[y, mirrored] and abs(seen[y, mirrored] - seen[y, source]) <= SAME_SURFACE_PX
            beside = mean_beside(image, seen, pure, y, source, inwards)
            filled[y, x] = image[y, mirrored] if same and not narrow else beside
            drawn[y, x] = False
    return filled, drawn


def mean_beside(image, seen, pure, y, source, inwards):
    height, width = pure.shape
    rows = [row for row in (y - 1, y, y, y + 1) if 0 <= row < height]
    columns = [source, min(max(source + inwards, 0), width - 1)]
    beside = [
        image[row, column]
        for row in rows
        for column in columns
        if pure[row, column] and abs(seen[row, column] - seen[y, source]) <= SAME_SURFACE_PX
    ]
    return np.floor(np.mean(beside, axis=0) + 0.5)
