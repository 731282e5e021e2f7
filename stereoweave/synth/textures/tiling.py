"""Building blocks for tileable textures: noise, Voronoi cells, and drawing with wraparound.

All maps are periodic and have SIDE x SIDE texels. Colours are sRGB levels in 0..255. Heights are levels in
0..255, centred on 128.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

SIDE = 512

Map = Float[np.ndarray, "side side"]
Colours = Float[np.ndarray, "side side 3"]
Texture = Float[np.ndarray, "side side 4"]  # colour and height
Canvas = UInt8[np.ndarray, "side side 4"]
Colour = tuple[float, float, float]


class Cells(NamedTuple):
    """Voronoi cells of scattered sites.

    Attributes:
        label: int [SIDE, SIDE], index of each texel's cell.
        rim: float32 [SIDE, SIDE], approximate distance to the cell's border in texels.
        number: number of cells.
    """

    label: Int[np.ndarray, "side side"]
    rim: Map
    number: int

    def per_texel(self, values: np.ndarray) -> np.ndarray:
        """Return each texel's value, given one value per cell ([N] or [N, C])."""
        return values.astype(np.float32)[self.label]


def noise(
    rng: np.random.Generator,
    exponent: float = 1.2,
    cycles: float = 2.0,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> Map:
    """Return periodic noise with mean 0 and standard deviation 1.

    Its amplitude is proportional to frequency**-exponent; photographs have an exponent of about 1.

    Args:
        rng: Random number generator.
        exponent: Smoothness of the noise.
        cycles: Number of periods per side below which the spectrum is flat, so no large blot reveals the
            tiling.
        stretch: Elongation of structures along y and along x.
    """
    along_y, along_x = stretch[0] * np.fft.fftfreq(SIDE), stretch[1] * np.fft.rfftfreq(SIDE)
    squared = np.add.outer((along_y**2).astype(np.float32), (along_x**2).astype(np.float32))
    strength = np.maximum(squared, (cycles / SIDE) ** 2) ** (-exponent / 2)
    # A sum of many waves is nearly normal for any distribution of amplitudes; uniform amplitudes are fastest.
    waves = rng.random((SIDE, SIDE // 2 + 1, 2), np.float32).view(np.complex64)[..., 0] - (0.5 + 0.5j)
    spectrum = waves.astype(np.complex64) * strength
    spectrum[0, 0] = 0
    values = np.fft.irfft2(spectrum, (SIDE, SIDE))
    return values / values.std()


def texel_grid() -> tuple[Map, Map]:
    """Return the y and x coordinates of the texels."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    return y, x


def voronoi_cells(
    rng: np.random.Generator, rows: int, columns: int, jitter: float = 0.45, rough: float = 0.0
) -> Cells:
    """Return the Voronoi cells of a jittered grid of rows x columns sites.

    The borders of the cells wander by about `rough` texels.
    """
    home = np.indices((rows, columns)).reshape(2, -1).T + 0.5
    sites = home + jitter * rng.uniform(-1, 1, home.shape)
    y, x = (sites * [SIDE / rows, SIDE / columns]).astype(int).T % SIDE
    away = np.ones((SIDE, SIDE), np.uint8)
    away[y, x] = 0
    wide = cv2.copyMakeBorder(away, SIDE // 2, SIDE // 2, SIDE // 2, SIDE // 2, cv2.BORDER_WRAP)
    _, nearest = cv2.distanceTransformWithLabels(wide, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    number = np.zeros(nearest.max() + 1, np.float32)
    number[nearest[wide == 0]] = np.pad(_number_sites(away), SIDE // 2, mode="wrap")[wide == 0]
    label = number[nearest[SIDE // 2 : -SIDE // 2, SIDE // 2 : -SIDE // 2]]
    if rough:
        wander = [rough * noise(rng, 1.8, 5) for _ in range(2)]
        label = warp(label, wander[0], wander[1], cv2.INTER_NEAREST)
    return Cells(label.astype(np.int32), _rim(label), int(label.max()) + 1)


def _number_sites(away: UInt8[np.ndarray, "side side"]) -> Map:
    return (np.cumsum(away == 0) - 1).reshape(away.shape).astype(np.float32)


def _rim(label: Map) -> Map:
    edge = (label != np.roll(label, 1, 0)) | (label != np.roll(label, 1, 1))
    wide = cv2.copyMakeBorder((~edge).astype(np.uint8), 64, 64, 64, 64, cv2.BORDER_WRAP)
    distance = cv2.distanceTransform(wide, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[64:-64, 64:-64]
    # Distances in whole texels would make joints jagged.
    return blur(distance, 0.7)


def warp(image: np.ndarray, down: Map, right: Map, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Warp an image by sampling each texel from `down` texels below and `right` texels to the right."""
    y, x = texel_grid()
    return cv2.remap(image, x + right, y + down, interpolation, borderMode=cv2.BORDER_WRAP)


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image with wraparound; `sigma` is the standard deviation of the Gaussian in texels."""
    margin = int(4 * sigma) + 1
    padded = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_WRAP)
    return cv2.GaussianBlur(padded, (0, 0), sigma)[margin:-margin, margin:-margin]


def smear_down(source: Map, length: float) -> Map:
    """Smear a map downwards, fading over `length` texels, like rust and dirt that run down a wall."""
    tail = np.exp(-np.arange(SIDE, dtype=np.float32) / length)
    spectrum = np.fft.rfft(source, axis=0) * np.fft.rfft(tail / tail.sum())[:, None]
    return np.fft.irfft(spectrum, SIDE, axis=0).astype(np.float32)


def paint_polygons(
    canvas: Canvas,
    polygons: Float[np.ndarray, "n k 2"],
    levels: Float[np.ndarray, "n 4"],
) -> None:
    """Paint polygons (x and y in texels) onto a canvas in the given order, with wraparound.

    levels: colour and height of each polygon.
    """
    low, high = polygons.min(1), polygons.max(1)
    shifts = SIDE * (np.indices((3, 3)).reshape(2, 9).T - 1)
    seen = ((high[:, None] + shifts > -1) & (low[:, None] + shifts < SIDE)).all(-1)
    # OpenCV antialiases poorly at an image's border, so the canvas is padded.
    margin = 4
    wide = cv2.copyMakeBorder(canvas, margin, margin, margin, margin, cv2.BORDER_WRAP)
    corners = np.round((polygons + margin) * 16).astype(np.int32)
    shades = np.clip(levels, 0, 255).tolist()
    for number, shift in np.argwhere(seen).tolist():
        cv2.fillPoly(wide, [corners[number] + 16 * shifts[shift]], shades[number], cv2.LINE_AA, 4)
    canvas[:] = wide[margin:-margin, margin:-margin]


def blade_outlines(
    at: Float[np.ndarray, "n 2"],
    turns: Float[np.ndarray, "n 2"],
    length: Float[np.ndarray, " n"],
    wide: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 8 2"]:
    """Return the outlines of tapering blades of grass or straw.

    turns: directions at the root and at the tip, in radians.
    """
    share = np.linspace(0, 1, 4)
    way = turns[:, :1] + share * (turns[:, 1:] - turns[:, :1])
    steps = np.stack([np.cos(way), np.sin(way)], -1) * (length / 4)[:, None, None]
    spine = at[:, None] + np.cumsum(steps, 1)
    across = np.stack([-np.sin(way), np.cos(way)], -1) * (wide[:, None] * (1.05 - share**2))[..., None]
    return np.concatenate([spine - across, (spine + across)[:, ::-1]], 1)


def distance_to_lines(position: np.ndarray, first: float, period: float) -> Map:
    """Return the distance to the nearest of the lines at `first`, `first + period`, ..."""
    return np.abs((position - first + period / 2) % period - period / 2).astype(np.float32)


def smoothstep(low: float, high: float, values: Map) -> Map:
    """Return a smooth step from 0 at `low` to 1 at `high`; the step falls if low > high."""
    share = np.clip((values - low) / (high - low), 0, 1)
    return share * share * (3 - 2 * share)


def mix(first: np.ndarray | Colour, second: np.ndarray | Colour, share: Map) -> Colours:
    """Blend two images or colours linearly.

    The result is (1 - share) * first + share * second.
    """
    first, second = np.asarray(first, np.float32), np.asarray(second, np.float32)
    return first + share[..., None] * (second - first)


def ramp(values: Map, *colours: Colour) -> Colours:
    """Map values in 0..1 to a ramp of evenly spaced colours."""
    at, stops = np.linspace(0, len(colours) - 1, 1024), range(len(colours))
    table = np.stack([np.interp(at, stops, channel) for channel in np.transpose(colours)], -1)
    return table.astype(np.float32)[np.clip(values * 1023, 0, 1023).astype(np.int32)]


def tint_grey(levels: Map, red: float, blue: float) -> Colours:
    """Convert grey levels to RGB, scaling red and blue by the given factors."""
    return np.dstack([levels * red, levels, levels * blue]).astype(np.float32)


def stack_texture(colours: Colours, height: Map) -> Texture:
    """Stack colours and a height map, clipped to -1..1, into a texture."""
    return np.dstack([colours, 128 + 127 * np.clip(height, -1, 1)]).astype(np.float32)
