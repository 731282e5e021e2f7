"""Lattice structures and related parts: masts, cables, ladders, railings and insulator strings.

A lattice is built as segments from joint to joint, so its members meet exactly. The segments are converted to
tubes at the end. Lengths are in metres, and z is up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.primitives import Numbers, Points, copies, lathe, orthogonal_frames, tubes
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

Segments = Float[np.ndarray, "_ 2 3"]
Bracing = Literal["cross", "zigzag", "single"]


@dataclass(frozen=True, kw_only=True)
class Truss:
    """Members of a lattice, as segments [N, 2, 3] from joint to joint in metres.

    Attributes:
        legs: members along the lattice.
        struts: members around each ring of joints.
        braces: diagonals within the faces.
    """

    legs: Segments
    struts: Segments
    braces: Segments

    def mesh(self, leg_radius_m: float, brace_radius_m: float, material: int, sides: int = 5) -> Mesh:
        """Build the members as round bars."""
        others = np.concatenate([self.struts, self.braces])
        return join_meshes(
            [
                bars(self.legs, leg_radius_m, material, sides + 1, capped=False),
                bars(others, brace_radius_m, material, sides, capped=False),
            ]
        )

    def banded_mesh(
        self,
        leg_radius_m: float,
        brace_radius_m: float,
        materials: Sequence[int],
        bands_m: tuple[float, float],
    ) -> Mesh:
        """Build the members as round bars, painted in bands; the midpoint of a member determines its band.

        bands_m: length of a band along x and along z.
        """
        return join_meshes(
            self._within(band, len(materials), bands_m).mesh(leg_radius_m, brace_radius_m, material)
            for band, material in enumerate(materials)
        )

    def _within(self, band: int, count: int, bands_m: tuple[float, float]) -> "Truss":
        def select(segments: Segments) -> Segments:
            return segments[np.floor((segments.mean(1)[:, ::2] / bands_m).sum(1)) % count == band]

        return Truss(legs=select(self.legs), struts=select(self.struts), braces=select(self.braces))


def mast_levels(
    stations_m: Sequence[float], widths_m: Sequence[float], ratio: float
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return the heights of a tapering mast's joints, and the widths of the mast at those heights.

    Every station is a joint; the panels between stations are about `ratio` times as high as they are wide.
    """
    heights = [np.array(stations_m[:1], float)]
    for low, high, width, top in zip(stations_m, stations_m[1:], widths_m, widths_m[1:], strict=False):
        count = max(round((high - low) / (ratio * np.sqrt(width * top))), 1)
        # Panels of equal proportions shrink by a constant factor.
        sizes = (top / width) ** (np.arange(count) / count)
        heights.append(low + (high - low) * np.cumsum(sizes) / sizes.sum())
    joints = np.concatenate(heights)
    return joints, np.interp(joints, stations_m, widths_m)


def mast_rings(
    heights_m: Float[np.ndarray, " k"], widths_m: float | Float[np.ndarray, " k"], corners: int = 4
) -> Float[np.ndarray, "k m 3"]:
    """Return the joints of an upright mast: one regular polygon per height.

    The sides of a square are along x and y.

    widths_m: side length at each height.
    """
    angle = (np.arange(corners) + 0.5) * 2 * np.pi / corners
    radius = np.broadcast_to(widths_m, heights_m.shape) / (2 * np.sin(np.pi / corners))
    across = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([across, np.broadcast_to(heights_m[:, None, None], (*across.shape[:2], 1))], -1)


def truss(rings_m: Float[np.ndarray, "k m 3"], bracing: Bracing = "zigzag") -> Truss:
    """Return the lattice that connects rings of joints.

    Each face between two rings is braced by both diagonals ("cross"), by diagonals of alternating direction
    ("zigzag"), or by diagonals of one direction ("single").
    """
    ahead = np.roll(rings_m, -1, axis=1)
    rising = _segments(rings_m[:-1], ahead[1:])
    falling = _segments(ahead[:-1], rings_m[1:])
    odd = np.repeat(np.arange(len(rings_m) - 1) % 2 == 1, rings_m.shape[1])[:, None, None]
    braces = {
        "cross": np.concatenate([rising, falling]),
        "zigzag": np.where(odd, rising, falling),
        "single": rising,
    }
    return Truss(
        legs=_segments(rings_m[:-1], rings_m[1:]), struts=_segments(rings_m, ahead), braces=braces[bracing]
    )


def bars(
    segments_m: Segments, radius_m: float | np.ndarray, material: int, sides: int = 5, capped: bool = True
) -> Mesh:
    """Build round bars along segments; set capped=False if joints hide the ends."""
    return tubes(segments_m[:, 0], segments_m[:, 1], radius_m, material, sides, capped)


def chain_segments(points_m: Float[np.ndarray, "n k 3"]) -> Segments:
    """Return the segments of N polylines as one array."""
    return _segments(points_m[:, :-1], points_m[:, 1:])


def sagging_points(
    starts_m: Numbers, ends_m: Numbers, sag_m: float | Float[np.ndarray, " n"], count: int = 12
) -> Float[np.ndarray, "n k 3"]:
    """Return points [N, count + 1, 3] on parabolic cables that sag by sag_m in the middle."""
    starts, ends = np.broadcast_arrays(np.atleast_2d(starts_m), np.atleast_2d(ends_m))
    share = np.linspace(0, 1, count + 1)
    points = starts[:, None] + share[:, None] * (ends - starts)[:, None]
    points[..., 2] -= np.reshape(sag_m, (-1, 1)) * 4 * share * (1 - share)
    return points


def cables(  # noqa: PLR0913 - dimensions
    starts_m: Numbers,
    ends_m: Numbers,
    radius_m: float,
    material: int,
    *,
    sag_m: float | Float[np.ndarray, " n"] = 0.0,
    count: int = 12,
) -> Mesh:
    """Build sagging cables [N] between pairs of points."""
    path = sagging_points(starts_m, ends_m, sag_m, count)
    return bars(chain_segments(path), radius_m, material, sides=5, capped=False)


def ladder(
    foot_m: tuple[float, float, float],
    head_m: tuple[float, float, float],
    sideways: tuple[float, float, float],
    width_m: float,
    material: int,
) -> Mesh:
    """Build a ladder with rungs along `sideways`, at intervals of 3/4 of its width."""
    foot, head = np.array(foot_m), np.array(head_m)
    half = width_m / 2 * np.array(sideways) / np.linalg.norm(sideways)
    count = max(round(np.linalg.norm(head - foot) / (0.75 * width_m)), 2)
    share = (np.arange(count) + 0.5) / count
    middles = foot + share[:, None] * (head - foot)
    rails = np.stack([[foot - half, head - half], [foot + half, head + half]])
    return join_meshes(
        [
            bars(rails, 0.075 * width_m, material, sides=4),
            bars(_segments(middles - half, middles + half), 0.05 * width_m, material, sides=4, capped=False),
        ]
    )


def cage(
    foot_m: tuple[float, float, float],
    head_m: tuple[float, float, float],
    outwards: tuple[float, float, float],
    width_m: float,
    material: int,
) -> Mesh:
    """Build the safety cage of an upright ladder from hoops and strips."""
    foot, head = np.array(foot_m), np.array(head_m)
    out = np.array(outwards) / np.linalg.norm(outwards)
    side = np.cross(out, [0.0, 0.0, 1.0])
    angle = np.radians(np.linspace(-90, 90, 7))
    bow = width_m * (0.7 * np.sin(angle)[:, None] * side + 1.3 * np.cos(angle)[:, None] * out)
    count = max(int(np.linalg.norm(head - foot) / (1.6 * width_m)), 1) + 1
    hoops = np.linspace(foot, head, count)[:, None] + bow
    strips = hoops[:, 1:-1].swapaxes(0, 1)
    members = np.concatenate([chain_segments(hoops), chain_segments(strips)])
    return bars(members, 0.045 * width_m, material, sides=4, capped=False)


def railing(  # noqa: PLR0913 - dimensions
    path_m: Points, height_m: float, spacing_m: float, radius_m: float, material: int, rails: int = 2
) -> Mesh:
    """Build a railing of posts and rails along a path.

    Posts stand at the path's corners and at most spacing_m apart.
    """
    lengths = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
    counts = np.maximum(np.ceil(lengths / spacing_m), 1).astype(int)
    feet = np.concatenate(
        [
            np.linspace(start, end, count, endpoint=False)
            for start, end, count in zip(path_m[:-1], path_m[1:], counts, strict=True)
        ]
        + [path_m[-1:]]
    )
    up = np.array([0.0, 0.0, height_m])
    heights = (np.arange(rails) + 1)[:, None, None] / rails * up
    return join_meshes(
        [
            bars(_segments(feet, feet + up), radius_m, material, sides=4, capped=False),
            bars(chain_segments(path_m[None] + heights), 0.8 * radius_m, material, sides=4, capped=False),
        ]
    )


def poses_towards(at_m: Numbers, directions: Numbers) -> Float[np.ndarray, "n 4 4"]:
    """Return poses [N, 4, 4] at the given points, with z along the directions and x horizontal."""
    at, along = np.broadcast_arrays(np.atleast_2d(at_m), np.atleast_2d(directions))
    z = along / np.linalg.norm(along, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(z), 1, 1))
    poses[:, :3, :3] = np.stack([*orthogonal_frames(z), z], -1)
    poses[:, :3, 3] = at
    return poses


def insulators(starts_m: Points, ends_m: Points, radius_m: float, discs: int, material: int) -> Mesh:
    """Build insulator strings of bell-shaped discs that open towards the end of the string."""
    starts_m, ends_m = np.broadcast_arrays(np.atleast_2d(starts_m), np.atleast_2d(ends_m))
    pitch = float(np.linalg.norm(ends_m - starts_m, axis=1).mean()) / discs
    bell = np.array([[0.0, 0.15], [0.95, 0.15], [1.0, 0.3], [0.35, 0.75], [0.3, 1.0]]) * (radius_m, pitch)
    share = np.arange(1, discs + 1)[:, None, None] / discs
    at = (starts_m + share * (ends_m - starts_m)).reshape(-1, 3)
    return copies(
        lathe(bell, material, sections=8), poses_towards(at, np.tile(starts_m - ends_m, (discs, 1)))
    )


def galvanised_steel(rng: np.random.Generator) -> Material:
    """Draw a random material for galvanised steel, from bright to dark."""
    grey = rng.uniform(0.35, 0.85)
    return Material(
        texture="steel",
        variant=int(rng.integers(8)),
        tint=(grey, grey * 1.01, grey * 1.02),
        span_m=0.8,
        roughness=rng.uniform(0.5, 0.75),
        metal=rng.uniform(0.1, 0.5),
        relief=0.1,
    )


def painted_steel(rng: np.random.Generator, tint: Colour, roughness: float = 0.55) -> Material:
    """Draw a material for painted steel, slightly lighter or darker than the given colour."""
    shade = rng.uniform(0.85, 1.1)
    red, green, blue = (float(np.clip(shade * part, 0, 1)) for part in tint)
    return Material(
        texture="paint",
        variant=int(rng.integers(8)),
        tint=(red, green, blue),
        span_m=rng.uniform(0.8, 2.0),
        roughness=roughness,
        relief=0.1,
    )


def aviation_paints(rng: np.random.Generator) -> tuple[Material, Material]:
    """Draw random red and white paints for aviation obstacle markings."""
    return painted_steel(rng, (0.55, 0.07, 0.04)), painted_steel(rng, (0.8, 0.8, 0.77))


def _segments(starts_m: np.ndarray, ends_m: np.ndarray) -> Segments:
    return np.stack([starts_m, ends_m], -2).reshape(-1, 2, 3)
