"""Textures of bare, rusty and painted metal."""

import numpy as np

from stereoweave.synth.textures.tiling import (
    SIDE,
    Texture,
    blur,
    mix,
    noise,
    paint_polygons,
    ramp,
    smear_down,
    smoothstep,
    stack_texture,
    texel_grid,
    tint_grey,
    voronoi_cells,
)
from stereoweave.synth.textures.wear import dirt_map


def rust(rng: np.random.Generator) -> Texture:
    """Draw rusty steel with brown and orange patches, dark pits and rain streaks."""
    broad, fine = noise(rng, 1.3, 3), noise(rng, 0.8, 8)
    tone = 0.5 + 0.17 * broad + 0.12 * fine
    colours = ramp(tone, (56, 43, 38), (86, 59, 47), (116, 76, 54), (142, 100, 72), (132, 108, 88))
    bare = smoothstep(0.7, 1.3, noise(rng, 1.5, 4) + 0.3 * fine) * rng.uniform(0.3, 0.9)
    colours = mix(colours, (86, 82, 80), bare)
    pits = smoothstep(1.1, 1.8, noise(rng, 0.7, 30))
    runs = smear_down(smoothstep(1.3, 2, noise(rng, 0.9, 10)), rng.uniform(40, 120))
    colours *= (1 - 0.45 * pits - 0.9 * np.minimum(runs, 0.5))[..., None]
    return stack_texture(colours, 0.18 * broad + 0.16 * fine - 0.4 * pits - 0.1 * bare)


def paint(rng: np.random.Generator) -> Texture:
    """Draw old, dirty, nearly white paint, chipped, with rust around the chips and streaks below them."""
    broad, edge = noise(rng, 1.5, 3), noise(rng, 1.0, 14)
    damage = noise(rng, 1.6, 5) + 0.45 * edge
    limit = rng.uniform(2.2, 3.1)
    chips, rim = smoothstep(limit, limit + 0.08, damage), smoothstep(limit - 0.35, limit, damage)
    runs = smear_down(chips + 0.4 * (rng.random((SIDE, SIDE)) < 0.0004), rng.uniform(30, 90))
    colours = mix((232, 230, 224), (214, 211, 203), smoothstep(-1.5, 1.5, broad))
    colours = mix(colours, (150, 112, 84), np.minimum(3.5 * blur(runs, 1.5), 0.65))
    colours = mix(colours, (176, 148, 122), 0.5 * rim)
    base = ramp(0.5 + 0.2 * edge, (70, 52, 44), (108, 76, 56), (126, 96, 74))
    colours = mix(colours, base, chips)
    colours *= (1 - 0.1 * dirt_map(rng) + 0.012 * noise(rng, 0.4))[..., None]
    return stack_texture(colours, 0.25 + 0.03 * broad + 0.02 * edge - 0.6 * chips)


def brushed_steel(rng: np.random.Generator) -> Texture:
    """Draw steel brushed along x."""
    lines = noise(rng, 0.7, 4, stretch=(1, 60))
    broad = noise(rng, 1.5, 2)
    colours = tint_grey(164 + 14 * lines + 9 * broad - 18 * dirt_map(rng), 0.99, 1.01)
    return stack_texture(colours, 0.12 * lines)


def spangled_steel(rng: np.random.Generator) -> Texture:
    """Draw galvanised steel with zinc crystals in different shades of grey."""
    large = voronoi_cells(rng, 22, 22, 0.5, rough=2)
    small = voronoi_cells(rng, 64, 64, 0.5)
    feathers = noise(rng, 0.8, 20, stretch=(1, 3))
    grey = (
        158
        + large.per_texel(rng.normal(0, 15, large.number))
        + small.per_texel(rng.normal(0, 6, small.number))
    )
    grey += 5 * feathers + 7 * noise(rng, 1.3, 3) - 25 * dirt_map(rng)
    white_rust = smoothstep(1.2, 2.4, noise(rng, 1.5, 4)) * 0.5
    colours = mix(tint_grey(blur(grey, 0.7), 0.97, 1.01), (205, 205, 200), white_rust)
    return stack_texture(colours, 0.05 * feathers + 0.1 * white_rust)


def scratched_steel(rng: np.random.Generator) -> Texture:
    """Draw worn, bare steel with smears and with scratches of all lengths."""
    canvas = np.full((SIDE, SIDE, 4), 128, np.uint8)
    count = 900
    turn, length = rng.normal(0.3, 0.7, count), np.exp(rng.normal(3.2, 0.8, count))
    along = np.stack([np.cos(turn), np.sin(turn)], -1) * length[:, None]
    across = along[:, ::-1] * (-1, 1) * (0.35 * np.exp(rng.normal(0, 0.5, count)) / length)[:, None]
    start = rng.uniform(0, SIDE, (count, 2))
    strips = np.stack([start - across, start + across, start + along + across, start + along - across], 1)
    paint_polygons(canvas, strips, rng.choice([88.0, 108.0, 150.0, 190.0], (count, 1)).repeat(4, 1))
    marks = canvas[..., 0].astype(np.float32) - 128
    smears = noise(rng, 1.4, 2) + 0.5 * noise(rng, 1.0, 4, stretch=(1, 6))
    grey = 140 + 13 * smears + 0.55 * marks + 4 * noise(rng, 0.5) - 20 * dirt_map(rng)
    return stack_texture(tint_grey(grey, 1.0, 0.98), marks / 250)


def tread_plate(rng: np.random.Generator) -> Texture:
    """Draw chequer plate with raised bars in alternating directions, worn bright on top."""
    y, x = texel_grid()
    pitch = SIDE / 16
    row, column = y // pitch, x // pitch
    along, across = (y % pitch) - pitch / 2, (x % pitch) - pitch / 2
    turned = (row + column) % 2 > 0
    u, v = np.where(turned, along + across, along - across), np.where(turned, along - across, along + across)
    bar = smoothstep(1.15, 0.85, np.hypot(u / (0.62 * pitch), v / (0.2 * pitch)).astype(np.float32))
    wear = noise(rng, 1.3, 2)
    grey = 116 + bar * (44 + 14 * wear) + 8 * noise(rng, 0.9) + 8 * wear - 26 * dirt_map(rng) * (1 - bar)
    colours = mix(
        tint_grey(grey, 1.0, 0.98), (112, 86, 66), 0.5 * smoothstep(0.8, 2, noise(rng, 1.4, 4)) * (1 - bar)
    )
    return stack_texture(colours, 1.1 * bar - 0.5)
