"""Wind turbine heads with twisted blades, a hub with a spinner, and a nacelle."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.lattice import bars, railing
from stereoweave.synth.props.primitives import boxes, copies, lathe, loft, rotation, spheres
from stereoweave.synth.world import Material, Mesh, join_meshes

STATIONS = 22  # cross-sections along a blade
OVERHANG_M = 0.34  # distance from the tower axis to the rotor plane


@dataclass(frozen=True, kw_only=True)
class Rotor:
    """Dimensions of a rotor around the x axis, with upwind at +x.

    Attributes:
        radius_m: distance from the axis to the tips.
        chord_m: greatest width of a blade.
        pitch_deg: angle between the blades and the rotor plane; 90 means feathered.
        angle_deg: angle of the first blade from vertical.
        tilt_deg: upward tilt of the axis.
    """

    radius_m: float
    chord_m: float
    pitch_deg: float
    angle_deg: float
    tilt_deg: float = 4.0


@dataclass(frozen=True, kw_only=True)
class TurbineMaterials:
    """Materials of a wind turbine.

    `tip` colours the bands near the blade tips and may equal `white`.
    """

    white: int
    tip: int
    steel: int
    dark: int
    lamp: int


def composite_skin(rng: np.random.Generator) -> Material:
    """Draw a random white or light grey material for blades and towers."""
    grey = rng.uniform(0.68, 0.85)
    return Material(
        texture="plain",
        variant=int(rng.integers(64)),
        tint=(grey, grey, 0.98 * grey),
        span_m=2.5,
        roughness=rng.uniform(0.35, 0.6),
        relief=0.05,
    )


def turbine_head(rotor: Rotor, materials: TurbineMaterials, around: int = 18) -> Mesh:
    """Build the nacelle, hub and blades of a turbine; the top of its tower is at the origin.

    around: number of points per blade section.
    """
    blades = copies(_blade(rotor, materials, around), _turns(rotor.angle_deg, 3))
    turning = join_meshes([blades, _hub(rotor, materials)]).translate(OVERHANG_M)
    return (
        join_meshes([turning, _nacelle(materials)])
        .transform(rotation((0, 1, 0), -rotor.tilt_deg))
        .translate(z=0.17)
    )


def _turns(angle_deg: float, count: int) -> Float[np.ndarray, "n 4 4"]:
    return np.stack([rotation((1, 0, 0), angle_deg + 360 * k / count) for k in range(count)])


def _blade(rotor: Rotor, materials: TurbineMaterials, around: int) -> Mesh:
    """Build a twisted blade along z that bends upwind.

    It has a round root and is widest at a fifth of its length.
    """
    share = np.linspace(0, 1, STATIONS)
    radius = 0.05 * rotor.radius_m + 0.95 * rotor.radius_m * share
    root = 0.3 * rotor.chord_m
    grown = np.clip((share - 0.03) / 0.17, 0, 1)
    grown = grown * grown * (3 - 2 * grown)
    taper = np.interp(share, (0, 0.2, 0.6, 0.93, 1), (1, 1, 0.52, 0.24, 0.05)) * rotor.chord_m
    chord = root + grown * (taper - root)
    thickness = root + grown * (np.interp(share, (0, 0.2, 0.5, 1), (1, 0.3, 0.2, 0.14)) * taper - root)
    angle = np.arange(around) * 2 * np.pi / around
    # Sections are circles at the root; farther out they thin from the thickest point to the trailing edge.
    belly = 1 - grown[:, None] * 0.45 * (1 - np.cos(angle))
    along = chord[:, None] * (np.cos(angle) / 2 - 0.2 * grown[:, None])
    across = thickness[:, None] * np.sin(angle) / 2 * belly
    twist = np.radians(rotor.pitch_deg + 16 * (1 - share) ** 2)[:, None]
    y = along * np.cos(twist) - across * np.sin(twist)
    x = -(along * np.sin(twist) + across * np.cos(twist)) + 0.025 * rotor.radius_m * share[:, None] ** 2
    z = np.broadcast_to(radius[:, None], y.shape)
    mesh = loft(np.stack([x, y, z], -1), materials.white)
    middle = mesh.corners_m[:, :, 2].mean(1)
    first, last = radius[[STATIONS - 8, STATIONS - 4]]
    marked = ((middle > first) & (middle < last)) | (middle > radius[-2])
    return replace(mesh, material=np.where(marked, materials.tip, mesh.material).astype(np.int32))


def _hub(rotor: Rotor, materials: TurbineMaterials) -> Mesh:
    """Build a spinner that points upwind, and collars around the blade roots."""
    size = max(0.06 * rotor.radius_m, 0.12)
    profile = np.array(
        [(0, -1.0), (0.95, -1.0), (1.0, -0.5), (1.0, 0.3), (0.86, 0.85), (0.55, 1.25), (0.2, 1.42), (0, 1.45)]
    )
    collar = lathe(
        [(0, 0), (0.2 * rotor.chord_m, 0), (0.2 * rotor.chord_m, 1.12 * size), (0, 1.12 * size)],
        materials.steel,
        20,
    )
    return join_meshes(
        [
            lathe(profile * size, materials.white, 28).transform(rotation((0, 1, 0), 90)),
            copies(collar, _turns(rotor.angle_deg, 3)),
        ]
    )


def _nacelle(materials: TurbineMaterials) -> Mesh:
    """Build a rounded nacelle with a cooler, a railing, wind vanes, a lightning rod and lamps."""
    x = np.array([0.24, 0.21, 0.1, -0.25, -0.5, -0.62, -0.65])
    half = np.array([0.1, 0.135, 0.15, 0.155, 0.145, 0.12, 0.08])
    angle = np.arange(24) * 2 * np.pi / 24
    corner = (np.abs(np.cos(angle)) ** 5 + np.abs(np.sin(angle)) ** 5) ** -0.2
    y = -half[:, None] * corner * np.cos(angle)
    z = half[:, None] * corner * np.sin(angle) + 0.02
    skin = loft(np.stack([np.broadcast_to(x[:, None], y.shape), y, z], -1)[::-1], materials.white)
    roof = np.array(
        [
            [0.05, 0.13, 0.165],
            [-0.5, 0.13, 0.165],
            [-0.5, -0.13, 0.165],
            [0.05, -0.13, 0.165],
            [0.05, 0.13, 0.165],
        ]
    )
    masts = np.array(
        [
            [(-0.55, 0.09, 0.15), (-0.55, 0.09, 0.46)],
            [(-0.55, -0.09, 0.15), (-0.55, -0.09, 0.42)],
            [(-0.3, 0, 0.15), (-0.3, 0, 0.6)],
        ]
    )
    arms = np.array([[(-0.6, 0.09, 0.4), (-0.5, 0.09, 0.4)], [(-0.55, -0.13, 0.38), (-0.55, -0.05, 0.38)]])
    return join_meshes(
        [
            skin,
            lathe([(0.13, -0.2), (0.13, -0.1), (0.1, -0.1)], materials.steel, 24),
            boxes((-0.6, 0, 0.24), (0.06, 0.26, 0.16), materials.dark),
            boxes((-0.15, 0, 0.165), (0.2, 0.16, 0.02), materials.dark),
            railing(roof, 0.09, 0.14, 0.005, materials.steel),
            bars(np.concatenate([masts, arms]), 0.006, materials.steel, sides=4),
            spheres(arms.reshape(-1, 3), 0.015, materials.dark, 1),
            spheres([(-0.42, 0.1, 0.2), (-0.42, -0.1, 0.2)], 0.028, materials.lamp, 1),
        ]
    )
