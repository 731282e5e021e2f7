"""Rounded figures of people and animals without faces, standing on z = 0 and facing +x."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.primitives import loft, spheres, sweep
from stereoweave.synth.props.random_materials import draw_material_from
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Material, Mesh, join_meshes

_CLOTHS = ("cloth", "plain", "plain", "paint")
# Trunk of a person 1.7 m tall, from bottom to top: height, half-width along x and half-width along y.
_TRUNK_M = np.array(
    [
        [0.84, 0.08, 0.11],
        [0.90, 0.13, 0.17],
        [1.00, 0.12, 0.16],
        [1.12, 0.11, 0.14],
        [1.28, 0.13, 0.18],
        [1.40, 0.11, 0.19],
        [1.46, 0.07, 0.12],
        [1.50, 0.05, 0.05],
        [1.56, 0.05, 0.05],
    ]
)


@dataclass(frozen=True, kw_only=True)
class Clothes:
    """Materials of a person's clothes, skin and hair."""

    coat: int
    trousers: int
    skin: int
    hair: int


def draw_clothes(rng: np.random.Generator, palette: Palette) -> Clothes:
    """Draw random materials for a person's clothes, skin and hair, many of them plain."""
    brown = rng.uniform(0.15, 1.0)
    skin = (0.75 * brown, 0.5 * brown, 0.38 * brown)
    return Clothes(
        coat=palette.add(draw_material_from(rng, _CLOTHS, 2.0)),
        trousers=palette.add(draw_material_from(rng, _CLOTHS, 2.0)),
        skin=palette.add(Material(texture="plain", tint=skin, roughness=0.55, relief=0.05)),
        hair=palette.add(draw_material_from(rng, ("bark", "plain", "cloth"), 3.0)),
    )


def person(rng: np.random.Generator, clothes: Clothes) -> Mesh:
    """Build a person 1.5 to 1.9 m tall, standing or walking."""
    stride_m = rng.choice([0.03, rng.uniform(0.1, 0.35)])
    limbs = [limb for side in (-1, 1) for limb in _limbs(rng, clothes, side, stride_m)]
    head = spheres([[0.015, 0, 1.655]], [[0.095, 0.078, 0.12]], clothes.skin, subdivisions=3)
    hair = spheres([[-0.012, 0, 1.69]], [[0.095, 0.085, 0.1]], clothes.hair, subdivisions=3)
    trunk = loft(_ellipses(_TRUNK_M * [1, rng.uniform(0.9, 1.5), rng.uniform(0.9, 1.2)]), clothes.coat)
    scale = rng.uniform(0.88, 1.1)
    return join_meshes([trunk, head, hair, *limbs]).transform(np.diag([scale, scale, scale, 1.0]))


def animal(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a plump or slender animal about 1 m long, with four legs, ears and a tail."""
    fur, other = (
        palette.add(draw_material_from(rng, ("plain", "cloth", "plain", "bark"), 1.5)) for _ in range(2)
    )
    eye = palette.add(Material(texture="plain", tint=(0.03, 0.03, 0.03), roughness=0.12))
    plump, leg_m, head_m = rng.uniform(0.16, 0.3), rng.uniform(0.15, 0.45), rng.uniform(0.13, 0.24)
    back_m = leg_m + 0.8 * plump
    body = spheres(
        [[-0.25, 0, back_m], [0.12, 0, back_m + 0.03], [0.3, 0, back_m + 0.08]],
        np.outer([1.0, 1.05, 0.75], [1.1 * plump, plump, plump]),
        fur,
        subdivisions=3,
    )
    face = np.array([0.42 + 0.5 * plump, 0, back_m + plump + 0.5 * head_m])
    head = spheres([face], [[head_m, 0.9 * head_m, 0.95 * head_m]], fur, subdivisions=3)
    snout = spheres([face + [0.85 * head_m, 0, -0.25 * head_m]], 0.45 * head_m, other, subdivisions=3)
    both = np.array([[1, 1, 1], [1, -1, 1]])
    ear_size = head_m * rng.uniform([0.15, 0.2, 0.3], [0.3, 0.45, 0.9])
    ears = spheres(
        face + both * head_m * [-0.2, 0.65, 0.85], np.tile(ear_size, (2, 1)), other, subdivisions=3
    )
    eyes = spheres(face + both * head_m * [0.78, 0.42, 0.3], 0.13 * head_m, eye)
    feet = np.array([[x, y, 0.0] for x in (-0.35, 0.3) for y in (-0.5 * plump, 0.5 * plump)])
    legs = [_bent_limb(foot + [0, 0, back_m], foot + [0, 0, 0.05], 0.06, (0.09, 0.055), fur) for foot in feet]
    tip = np.array([-0.8, rng.normal(0, 0.2), back_m + rng.uniform(-0.3, 0.5)])
    tail = _bent_limb(np.array([-0.25 - plump, 0, back_m]), tip, 0.1, (0.06, 0.02), fur)
    return join_meshes([body, head, snout, ears, eyes, *legs, tail])


def _limbs(rng: np.random.Generator, clothes: Clothes, side: int, stride_m: float) -> list[Mesh]:
    """Build the leg, shoe, arm and hand on one side of a person; `side` is 1 for +y and -1 for -y."""
    ankle = np.array([side * stride_m, 0.1 * side, 0.08])
    leg = _bent_limb(np.array([0, 0.09 * side, 0.93]), ankle, 0.04, (0.1, 0.055), clothes.trousers)
    shoe = spheres([ankle + [0.05, 0, -0.03]], [[0.14, 0.05, 0.06]], clothes.hair)
    shoulder = np.array([0, 0.19 * side, 1.4])
    hand = np.array([rng.uniform(-0.15, 0.35), rng.uniform(0.2, 0.5) * side, rng.uniform(0.8, 1.25)])
    arm = _bent_limb(shoulder, hand, -0.08, (0.065, 0.038), clothes.coat)
    return [leg, shoe, arm, spheres([hand], 0.05, clothes.skin)]


def _bent_limb(
    start_m: Float[np.ndarray, "3"],
    end_m: Float[np.ndarray, "3"],
    bulge_m: float,
    radii_m: tuple[float, float],
    material: int,
) -> Mesh:
    """Build a round limb between two points, bent by bulge_m along x in the middle."""
    share = np.linspace(0, 1, 9)[:, None]
    path_m = (1 - share) * start_m + share * end_m + 4 * share * (1 - share) * [bulge_m, 0, 0]
    return sweep(path_m, np.linspace(*radii_m, 9), material, 12)


def _ellipses(heights_and_halves_m: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 24 3"]:
    """Return horizontal ellipses [K, 24, 3], one per row (height, half-width along x, half-width along y)."""
    angle = np.arange(24) * 2 * np.pi / 24
    z, along, across = (column[:, None] for column in heights_and_halves_m.T)
    return np.stack([along * np.cos(angle), across * np.sin(angle), z + 0 * angle], -1)
