"""Textures of walls and floors: concrete, plaster, brick and nearly plain surfaces."""

import numpy as np

from stereoweave.synth.textures.tiling import (
    SIDE,
    Colours,
    Map,
    Texture,
    blur,
    distance_to_lines,
    mix,
    noise,
    ramp,
    smear_down,
    smoothstep,
    stack_texture,
    texel_grid,
    tint_grey,
    warp,
)
from stereoweave.synth.textures.wear import crack_map, dirt_map


def cast_concrete(rng: np.random.Generator) -> Texture:
    """Draw cast concrete with formwork joints, tie holes and air bubbles."""
    colours, height = _concrete(rng)
    y, x = texel_grid()
    joint = np.minimum(distance_to_lines(y, 0, SIDE / 2), distance_to_lines(x, 0, SIDE / 2))
    line = smoothstep(2.2, 0.6, joint + 0.5 * noise(rng, 1.0, 20))
    hole = np.hypot(
        distance_to_lines(x, SIDE / 4, SIDE / 2), distance_to_lines(y, SIDE / 4, SIDE / 2)
    ).astype(np.float32)
    holes = smoothstep(6, 4.5, hole)
    colours = (colours + 6 * _per_panel(rng, y, x)[..., None]) * (1 - 0.4 * line - 0.55 * holes)[..., None]
    runs = smear_down(holes, 60)
    return stack_texture(colours * (1 - 0.5 * np.minimum(runs, 0.4))[..., None], height - 0.5 * line - holes)


def cracked_concrete(rng: np.random.Generator) -> Texture:
    """Draw concrete with cracks and repaired patches."""
    colours, height = _concrete(rng)
    cracks = crack_map(rng, 4, 0.0)
    patch = smoothstep(1.35, 1.45, noise(rng, 2.0, 2))
    colours = colours * (1 - 0.14 * patch)[..., None]
    return stack_texture(mix(colours, (52, 48, 44), 0.85 * cracks), height - 0.7 * cracks + 0.05 * patch)


def stained_concrete(rng: np.random.Generator) -> Texture:
    """Draw stained concrete with moss and with black and pale streaks left by water."""
    colours, height = _concrete(rng)
    soot = smear_down(smoothstep(1.0, 2.2, noise(rng, 0.9, 6, stretch=(1, 0.4))), 150)
    lime = smear_down(smoothstep(1.6, 2.4, noise(rng, 0.9, 8)), 70)
    colours = mix(colours, (58, 56, 52), np.minimum(3.2 * soot, 0.7))
    colours = mix(colours, (202, 200, 192), np.minimum(4 * lime, 0.5))
    moss = smoothstep(1.3, 2.6, noise(rng, 1.4, 3) + 0.3 * noise(rng, 0.6, 20)) * 0.6
    return stack_texture(mix(colours, (84, 88, 58), moss), height + 0.1 * moss)


def paving_slabs(rng: np.random.Generator) -> Texture:
    """Draw square paving slabs, weathered to different shades."""
    colours, height = _concrete(rng)
    y, x = texel_grid()
    pitch = SIDE / 4
    joint = np.minimum(distance_to_lines(y, 0, pitch), distance_to_lines(x, 0, pitch)) + 0.6 * noise(
        rng, 1.0, 16
    )
    gap = smoothstep(3.6, 1.4, joint)
    tone = rng.normal(0, 9, (4, 4))[(y // pitch).astype(int), (x // pitch).astype(int)].astype(np.float32)
    colours = (colours + tone[..., None]) * (1 - 0.06 * smoothstep(22, 4, joint))[..., None]
    colours = mix(colours, ramp(0.5 + 0.2 * noise(rng, 0.7), (58, 56, 44), (88, 86, 66)), gap)
    return stack_texture(colours, height + 0.1 - 0.7 * gap)


def trowelled_plaster(rng: np.random.Generator) -> Texture:
    """Draw hand-trowelled plaster with visible strokes, hairline cracks and damp patches."""
    strokes = warp(noise(rng, 1.2, 5, stretch=(1, 3)), 22 * noise(rng, 1.8, 2), 22 * noise(rng, 1.8, 2))
    broad = noise(rng, 1.6, 2)
    colours = ramp(0.5 + 0.2 * broad, (188, 178, 160), (206, 198, 182), (218, 212, 200))
    colours = colours + (4 * strokes + 2.5 * noise(rng, 0.5))[..., None]
    damp = smoothstep(0.9, 2.0, noise(rng, 1.6, 2)) * rng.uniform(0.1, 0.3)
    hair = crack_map(rng, 3, 0.7, width=0.9)
    colours *= (1 - damp - 0.35 * hair - 0.1 * dirt_map(rng))[..., None]
    return stack_texture(colours, 0.22 * strokes + 0.04 * broad - 0.4 * hair)


def roughcast_plaster(rng: np.random.Generator) -> Texture:
    """Draw roughcast plaster with gritty grains, small shadows and bare patches."""
    grain = blur(noise(rng, 0.0), 1.2)
    grain = grain / grain.std() + 0.4 * noise(rng, 1.0, 10)
    broad = noise(rng, 1.5, 2)
    colours = ramp(0.5 + 0.17 * broad + 0.06 * grain, (176, 167, 150), (198, 190, 174), (214, 208, 196))
    colours *= (1 - 0.1 * smoothstep(-0.4, -2.2, grain) - 0.2 * dirt_map(rng))[..., None]
    bare = smoothstep(2.2, 2.3, noise(rng, 1.8, 3) + 0.2 * noise(rng, 1.0, 20))
    colours = mix(colours, ramp(0.5 + 0.2 * noise(rng), (118, 104, 88), (150, 138, 122)), bare)
    return stack_texture(colours, 0.3 * grain * (1 - bare) - 0.5 * bare)


_BRICKS = (
    ((122, 74, 60), (142, 88, 70), (106, 66, 57), (154, 108, 88)),
    ((148, 128, 100), (164, 146, 118), (132, 110, 86), (118, 100, 82)),
    ((104, 70, 62), (86, 64, 60), (120, 80, 66), (96, 80, 75)),
    ((150, 104, 84), (162, 122, 102), (136, 95, 80), (126, 99, 88)),
)


def brickwork(rng: np.random.Generator) -> Texture:
    """Draw brickwork in stretcher bond, with recessed mortar and bricks in different shades."""
    y, x = texel_grid()
    wander = noise(rng, 1.4, 8)
    y, x = y + 0.8 * wander, x + 0.8 * noise(rng, 1.4, 8)
    rows, columns = 20, 8
    course, length = SIDE / rows, SIDE / columns
    row = np.floor(y / course)
    shifted = x + length * np.where(row % 2 > 0, 0.5, 0)
    number = ((row % rows) * columns + np.floor(shifted / length) % columns).astype(int)
    joint = np.minimum(distance_to_lines(y, 0, course), distance_to_lines(shifted, 0, length)) + 0.5 * noise(
        rng, 0.9, 20
    )
    mortar = smoothstep(3.0, 1.3, joint)
    palette = np.array(_BRICKS[rng.integers(len(_BRICKS))])
    shades = palette[rng.integers(0, 4, rows * columns)] * np.exp(rng.normal(0, 0.09, (rows * columns, 1)))
    grain, broad = noise(rng, 0.8, 10), noise(rng, 1.4, 2)
    colours = shades.astype(np.float32)[number] * (1 + 0.08 * grain + 0.06 * broad)[..., None]
    colours = mix(colours, (190, 184, 174), 0.45 * smoothstep(1.2, 2.6, noise(rng, 1.3, 4)))
    bed = ramp(0.5 + 0.2 * noise(rng, 0.6), (150, 142, 130), (178, 170, 156)) * rng.uniform(0.75, 1.05)
    colours = mix(colours, bed, mortar) * (1 - 0.2 * dirt_map(rng))[..., None]
    proud = rng.normal(0, 0.08, rows * columns).astype(np.float32)[number]
    return stack_texture(colours, 0.3 + proud + 0.1 * grain - (0.8 + proud) * mortar)


def near_plain(rng: np.random.Generator) -> Texture:
    """Draw an even, nearly white surface with almost no texture for stereo matching."""
    broad, fine = noise(rng, 1.5, 1), noise(rng, 0.8, 6)
    share = rng.uniform(0.008, 0.02)
    grey = 226 * (1 + share * (0.8 * broad + 0.6 * fine))
    return stack_texture(tint_grey(grey, 1.004, 0.992), 0.05 * broad + 0.05 * fine)


def _concrete(rng: np.random.Generator) -> tuple[Colours, Map]:
    """Return the colour and height of clean concrete."""
    broad, fine = noise(rng, 1.5, 2), noise(rng, 0.7, 10)
    colours = ramp(0.5 + 0.16 * broad + 0.06 * fine, (128, 124, 116), (158, 154, 146), (184, 181, 173))
    colours = colours + (3.5 * fine)[..., None]
    bubbles = smoothstep(2.7, 3.2, noise(rng, 0.35, 40))
    colours *= (1 - 0.5 * bubbles - 0.16 * dirt_map(rng))[..., None]
    return colours, 0.1 * fine + 0.06 * broad - 0.6 * bubbles


def _per_panel(rng: np.random.Generator, y: Map, x: Map) -> Map:
    half = SIDE // 2
    row, column = (y // half).astype(int), (x // half).astype(int)
    return rng.normal(0, 1, (2, 2)).astype(np.float32)[row, column]
