"""Textures of the collages: procedural patterns and crops of photographs.

The photographs are included in scikit-image's wheel; docs/training-data.md lists their licences.
"""

import functools
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

SIDE = 384  # texels; at no more than 1 texel per pixel, a texture spans the width of a training crop
BANK_SEED = 20_240_607
PHOTOGRAPH_CROPS = 110
NATURAL_TEXTURES = PHOTOGRAPH_CROPS + 90
PERIODIC_TEXTURES = 30
LIGHT_MAPS = 32

Texture = UInt8[np.ndarray, "side side 3"]
Picture = Float[np.ndarray, "side side 3"]  # the same before rounding, in grey levels
Pattern = Float[np.ndarray, "side side"]
Photograph = UInt8[np.ndarray, "_ _ 3"]
Procedure = Callable[[np.random.Generator], Picture]

# Excluded: Motorcycle (a test pair), lfw_subset (people without their consent), moon and page (no licence).
# The weights favour objects and places over scans and microscopy.
PHOTOGRAPHS = {
    "astronaut": 3,
    "brick": 2,
    "camera": 3,
    "cat": 3,
    "cell": 1,
    "clock": 1,
    "coffee": 3,
    "coins": 2,
    "grass": 3,
    "gravel": 3,
    "hubble_deep_field": 1,
    "immunohistochemistry": 2,
    "retina": 1,
    "rocket": 2,
    "text": 1,
}


@functools.cache
def make_natural(k: int) -> Texture:
    """Return natural texture `k`, from 0 to NATURAL_TEXTURES - 1.

    Each texture is made on first use and is the same in every process.
    """
    return crop_photograph(k) if k < PHOTOGRAPH_CROPS else make_procedural(NATURAL, k - PHOTOGRAPH_CROPS)


@functools.cache
def make_periodic(k: int) -> Texture:
    """Return periodic texture `k`, from 0 to PERIODIC_TEXTURES - 1.

    Each texture is made on first use and is the same in every process.
    """
    return make_procedural(PERIODIC, k)


def crop_photograph(k: int) -> Texture:
    """Make crop `k`, a part of a photograph, randomly rotated, mirrored, scaled and recoloured."""
    rng = np.random.default_rng((BANK_SEED, 1, k))
    weights = np.array(list(PHOTOGRAPHS.values()), float)
    photograph = _load_photograph(str(rng.choice(list(PHOTOGRAPHS), p=weights / weights.sum())))
    crop = _crop_turned(rng, photograph)
    # A grey photograph gets a tint; the colours of other photographs shift slightly.
    grey = np.ptp(crop, axis=2).max() < 3
    return _recolour(rng, crop.astype(np.float32), tint=0.16 if grey else 0.08)


def make_procedural(kinds: dict[str, Procedure], k: int) -> Texture:
    """Make procedural texture `k`; consecutive textures cycle through the kinds."""
    rng = np.random.default_rng((BANK_SEED, 2, k))
    image = kinds[list(kinds)[k % len(kinds)]](rng)
    # Photographs have detail at the scale of a pixel.
    detail = rng.uniform(1, 8) * draw_power_noise(rng, rng.uniform(0.3, 0.9))
    return np.clip(image + detail[..., None], 0, 255).astype(np.uint8)


def draw_power_noise(rng: np.random.Generator, exponent: float, side: int = SIDE) -> Pattern:
    """Draw noise with mean 0 and standard deviation 1, whose amplitude falls as frequency**-exponent.

    In photographs, the exponent is about 1.
    """
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    frequency[0, 0] = 1
    spectrum = np.fft.rfft2(rng.standard_normal((side, side))) * frequency**-exponent
    spectrum[0, 0] = 0
    noise = np.fft.irfft2(spectrum, (side, side)).astype(np.float32)
    return noise / noise.std()


def draw_natural_colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Draw an RGB colour in 0..255 that is typical of real surfaces: any hue, but usually muted."""
    hue, saturation, value = rng.random() * 360, rng.beta(1.2, 3.6), 0.1 + 0.85 * rng.beta(2.0, 1.7)
    hsv = np.array([[[hue, saturation, value]]], np.float32)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0] * 255


@functools.cache
def make_light_map(k: int) -> Float[np.ndarray, "64 64"]:
    """Return light map `k`, float32 [64, 64] with values around 1; half of the maps have a soft shadow."""
    rng = np.random.default_rng((BANK_SEED, 3, k))
    light = 1 + rng.uniform(0.05, 0.2) * draw_power_noise(rng, 2.5, 64)
    if rng.random() < 0.5:
        edge = rng.uniform(1.5, 12)
        height = draw_power_noise(rng, rng.uniform(1.8, 2.6), 64) - rng.uniform(-0.5, 1)
        shadow = 1 / (1 + np.exp(-edge * height))
        light *= 1 - rng.uniform(0.25, 0.7) * shadow
    return np.clip(light, 0.25, 1.6).astype(np.float32)


@functools.cache
def _load_photograph(name: str) -> Photograph:
    from skimage import data

    image = getattr(data, name)()
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image


def _crop_turned(rng: np.random.Generator, photograph: Photograph) -> Texture:
    height, width = photograph.shape[:2]
    # The crop covers most of the picture and is hardly upsampled, because blur is not a texture.
    span = max(min(height, width) * rng.uniform(0.7, 1.0), 0.8 * SIDE)
    angle = rng.uniform(0, 360) if rng.random() < 0.4 else rng.integers(4) * 90 + rng.normal(0, 4)
    shrunk = min(1.0, 1.4 * SIDE / span)  # area-averaged first, so that the rotation causes no aliasing
    small = cv2.resize(photograph, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
    matrix = cv2.getRotationMatrix2D((0, 0), angle, SIDE / (span * shrunk))
    centre = np.array([rng.uniform(0.3, 0.7) * small.shape[1], rng.uniform(0.3, 0.7) * small.shape[0]])
    matrix[:, 2] = SIDE / 2 - matrix[:, :2] @ centre
    size, flags = (SIDE, SIDE), cv2.INTER_CUBIC
    crop = cv2.warpAffine(small, matrix, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101)
    return crop[:, ::-1] if rng.random() < 0.5 else crop


def _recolour(rng: np.random.Generator, image: Float[np.ndarray, "_ _ 3"], tint: float) -> Texture:
    mean = image.mean(axis=(0, 1))
    gain = np.exp(rng.normal(0, tint, 3) + rng.normal(0, 0.1))
    contrast = rng.uniform(0.8, 1.3)
    return np.clip((mean + contrast * (image - mean)) * gain, 0, 255).astype(np.uint8)


def _colour_pattern(rng: np.random.Generator, pattern: Pattern) -> Picture:
    """Blend two random colours by a pattern in 0..1, and add noise as on real surfaces."""
    low, high = draw_natural_colour(rng), draw_natural_colour(rng)
    # Colours of equal brightness are rare in nature, and grey images cannot distinguish them.
    if abs(low.mean() - high.mean()) < 30:
        low, high = low * 0.5, high * 0.7 + 70
    grain = rng.uniform(0.02, 0.12) * draw_power_noise(rng, rng.uniform(0.7, 1.4))
    return (low + pattern[..., None] * (high - low)) * (1 + grain[..., None])


def _cloud(rng: np.random.Generator) -> Picture:
    return _make_coloured_noise(rng, rng.uniform(0.8, 1.7))


def _sand(rng: np.random.Generator) -> Picture:
    return _make_coloured_noise(rng, rng.uniform(0.3, 0.8))


def _make_coloured_noise(rng: np.random.Generator, exponent: float) -> Picture:
    bright, warm, green = (draw_power_noise(rng, exponent) for _ in range(3))
    # Photographs vary most in brightness, less in blue-yellow, and least in green-magenta.
    axes = np.array([[1, 1, 1], [1, 0, -1], [0.5, -1, 0.5]])
    strength = rng.uniform(15, 55) * np.array([1, rng.uniform(0.05, 0.35), rng.uniform(0.03, 0.2)])
    waves = np.stack([bright, warm, green], axis=-1) @ (strength[:, None] * axes).astype(np.float32)
    return draw_natural_colour(rng) * 0.6 + 45 + waves


def _marble(rng: np.random.Generator) -> Picture:
    bend = draw_power_noise(rng, rng.uniform(1.4, 2.0))
    return _colour_pattern(rng, 0.5 + 0.5 * np.sin(rng.uniform(2, 7) * bend))


def _dead_leaves(rng: np.random.Generator) -> Picture:
    """Draw overlapping shapes of all sizes, the "dead leaves" model of natural images."""
    # Counts fall with the cube of the size, so that every size covers the same area.
    inverse_squares = rng.uniform(1 / rng.uniform(30, 120) ** 2, 1 / rng.uniform(2, 5) ** 2, 1500)
    return _strew(rng, inverse_squares**-0.5, slim=rng.uniform(0.25, 0.9))


def _pebbles(rng: np.random.Generator) -> Picture:
    size = rng.uniform(4, 16)
    return _strew(rng, size * np.exp(rng.normal(0, 0.25, int(3 * (SIDE / size) ** 2 / 2))), slim=0.7)


def _strew(rng: np.random.Generator, radii: Float[np.ndarray, " n"], slim: float) -> Picture:
    palette = [draw_natural_colour(rng) for _ in range(rng.integers(2, 8))]
    image = np.full((SIDE, SIDE, 3), palette[0], np.float32)
    for radius in radii.tolist():
        centre = rng.integers(0, SIDE * 16, 2).tolist()
        shade = palette[rng.integers(len(palette))] * np.exp(rng.normal(0, 0.25)) + rng.normal(0, 6, 3)
        axes = [int(radius * 16), int(radius * 16 * rng.uniform(slim, 1) * slim)]
        cv2.ellipse(image, centre, axes, rng.uniform(0, 360), 0, 360, shade.tolist(), -1, cv2.LINE_8, 4)
    grain = rng.uniform(0, 0.12) * draw_power_noise(rng, rng.uniform(0.7, 1.5))
    return _soften(image) * (1 + grain[..., None])


def _soften(image: Picture) -> Picture:
    # Shapes that OpenCV draws without antialiasing are sharper than any photograph.
    return cv2.GaussianBlur(image, (0, 0), 0.6)


def _grain(rng: np.random.Generator) -> Picture:
    """Draw wood grain with fibres and with warped rings around a distant axis."""
    x, y = _make_turned_grid(rng)
    warp = draw_power_noise(rng, 2.0) * rng.uniform(3, 12)
    rings = np.hypot(x * rng.uniform(0.02, 0.2), y + warp - rng.uniform(-300, 300)) / rng.uniform(6, 30)
    fibres = cv2.resize(draw_power_noise(rng, 0.6)[:, ::16], (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    pattern = 0.6 * (rings % 1) ** 1.5 + 0.4 * np.clip(0.5 + 0.25 * fibres, 0, 1)
    return _soften(_colour_pattern(rng, pattern))


def _writing(rng: np.random.Generator) -> Picture:
    """Draw rows of marks that resemble writing."""
    page = np.zeros((SIDE, SIDE), np.uint8)
    size = rng.uniform(6, 30)
    y = size
    while y < SIDE:
        x = rng.uniform(0, 3 * size)
        while x < SIDE:
            if rng.random() < 0.85:
                glyph = [x, y] + rng.random((rng.integers(3, 7), 2)) * size * [0.7, 1]
                thickness = max(1, round(size * 0.1))
                cv2.polylines(page, [(glyph * 16).astype(np.int32)], False, 255, thickness, cv2.LINE_AA, 4)
            x += size * rng.uniform(0.7, 1.0)
        y += size * rng.uniform(1.3, 2.0)
    return _colour_pattern(rng, page / np.float32(255))


def _gradient(rng: np.random.Generator) -> Picture:
    x, y = _make_turned_grid(rng)
    pattern = np.clip(0.5 + x / SIDE + 0.3 * np.sin(y / rng.uniform(20, 120)), 0, 1)
    return _colour_pattern(rng, pattern)


def _scratches(rng: np.random.Generator) -> Picture:
    image = np.ascontiguousarray(_cloud(rng), np.float32)
    for _ in range(rng.integers(40, 400)):
        start, turn = rng.uniform(0, SIDE, 2), rng.uniform(0, 2 * np.pi)
        end = start + rng.uniform(5, 80) * np.array([np.cos(turn), np.sin(turn)])
        ends = (np.stack([start, end]) * 16).astype(int).tolist()
        shade, thickness = draw_natural_colour(rng).tolist(), int(rng.integers(1, 4))
        cv2.line(image, ends[0], ends[1], shade, thickness, cv2.LINE_8, 4)
    return _soften(image)


def _make_turned_grid(rng: np.random.Generator) -> tuple[Pattern, Pattern]:
    turn = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32) - SIDE / 2
    return np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x


def _stripes(rng: np.random.Generator) -> Picture:
    x, _ = _make_turned_grid(rng)
    period, sharpness = rng.uniform(6, 60), rng.uniform(0.8, 6)
    wave = np.sin(x * 2 * np.pi / period) + rng.uniform(-0.5, 0.5)
    return _colour_pattern(rng, 0.5 + 0.5 * np.tanh(sharpness * wave))


def _checks(rng: np.random.Generator) -> Picture:
    x, y = _make_turned_grid(rng)
    period = rng.uniform(10, 70)
    product = np.sin(x * 2 * np.pi / period) * np.sin(y * 2 * np.pi / (period * rng.uniform(0.6, 1.6)))
    return _colour_pattern(rng, 0.5 + 0.5 * np.tanh(rng.uniform(2, 15) * product))


def _grid_lines(rng: np.random.Generator) -> Picture:
    x, y = _make_turned_grid(rng)
    period, half_line = rng.uniform(10, 60), rng.uniform(0.8, 4)
    nearest = np.minimum(_distance_to_joint(x, period), _distance_to_joint(y, period * rng.uniform(0.5, 1.5)))
    return _colour_pattern(rng, np.clip(nearest - half_line + 0.5, 0, 1))


def _bricks(rng: np.random.Generator) -> Picture:
    x, y = _make_turned_grid(rng)
    course, length, joint = rng.uniform(10, 40), rng.uniform(20, 110), rng.uniform(0.8, 3)
    row = np.floor(y / course)
    shifted = x + length * (0.5 * (row % 2) if rng.random() < 0.7 else 0)
    nearest = np.minimum(_distance_to_joint(shifted, length), _distance_to_joint(y, course))
    tone = rng.normal(0.75, rng.uniform(0.02, 0.2), (97, 89))  # one tone per brick
    bricks = tone[row.astype(int) % 97, np.floor(shifted / length).astype(int) % 89]
    return _colour_pattern(rng, (np.clip(nearest - joint + 0.5, 0, 1) * bricks).astype(np.float32))


def _dots(rng: np.random.Generator) -> Picture:
    x, y = _make_turned_grid(rng)
    period = rng.uniform(8, 50)
    radius = period * rng.uniform(0.15, 0.42)
    distance = np.hypot((x + 0.5 * period) % period - period / 2, (y + 0.5 * period) % period - period / 2)
    return _colour_pattern(rng, np.clip(radius - distance + 0.5, 0, 1))


def _weave(rng: np.random.Generator) -> Picture:
    x, y = _make_turned_grid(rng)
    period = rng.uniform(5, 16)
    over = (np.floor(x / period) + np.floor(y / period)) % 2
    warp, weft = (np.abs(np.sin(np.pi * c / period)) for c in (x, y))
    pattern = np.where(over > 0, warp * (0.7 + 0.3 * weft), 0.8 * weft * (0.7 + 0.3 * warp))
    return _soften(_colour_pattern(rng, pattern))


def _distance_to_joint(position: Pattern, period: float) -> Pattern:
    return period / 2 - np.abs(position % period - period / 2)


NATURAL: dict[str, Procedure] = {
    "cloud": _cloud,
    "sand": _sand,
    "dead_leaves": _dead_leaves,
    "pebbles": _pebbles,
    "scratches": _scratches,
    "grain": _grain,
    "marble": _marble,
    "writing": _writing,
    "gradient": _gradient,
}
PERIODIC: dict[str, Procedure] = {
    "stripes": _stripes,
    "checks": _checks,
    "grid_lines": _grid_lines,
    "bricks": _bricks,
    "dots": _dots,
    "weave": _weave,
}
