"""Full-size cars, lorries and buses, facing +x and standing on z = 0."""

import numpy as np

from stereoweave.synth.props.lattice import painted_steel
from stereoweave.synth.props.primitives import boxes, prism, rotation, tubes
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

_PAINTS: tuple[Colour, ...] = (
    (0.85, 0.85, 0.84),
    (0.5, 0.51, 0.53),
    (0.06, 0.06, 0.07),
    (0.42, 0.07, 0.06),
    (0.1, 0.17, 0.36),
    (0.35, 0.37, 0.3),
)


def fleet(rng: np.random.Generator, palette: Palette) -> list[Mesh]:
    """Build two cars, a lorry and a bus in random colours."""
    glass = palette.add(Material(texture="plain", tint=(0.06, 0.08, 0.1), roughness=0.1))
    tyre = palette.add(Material(texture="plain", tint=(0.04, 0.04, 0.045), roughness=0.9))
    first, second, third = (
        palette.add(painted_steel(rng, _PAINTS[k], roughness=0.25)) for k in rng.permutation(len(_PAINTS))[:3]
    )
    return [
        _car(first, glass, tyre),
        _car(second, glass, tyre),
        _lorry(third, first, glass, tyre),
        _bus(second, glass, tyre),
    ]


def _car(paint: int, glass: int, tyre: int) -> Mesh:
    body = [(-2.1, 0.35), (2.1, 0.35), (2.15, 0.7), (1.0, 0.95), (-1.9, 0.98), (-2.15, 0.75)]
    cabin = [(-1.75, 0.95), (0.95, 0.93), (0.25, 1.38), (-1.2, 1.4)]
    roof = [(-1.25, 1.37), (0.3, 1.35), (0.15, 1.45), (-1.1, 1.46)]
    return join_meshes(
        [
            _extrude(body, 1.75, paint),
            _extrude(cabin, 1.5, glass),
            _extrude(roof, 1.45, paint),
            _wheels((-1.35, 1.3), 0.32, 1.6, tyre),
        ]
    )


def _lorry(cab: int, box: int, glass: int, tyre: int) -> Mesh:
    nose = [(2.3, 0.5), (4.2, 0.5), (4.25, 1.5), (4.0, 2.7), (2.3, 2.8)]
    return join_meshes(
        [
            _extrude(nose, 2.3, cab),
            _extrude([(4.16, 1.6), (4.24, 1.6), (4.06, 2.45), (3.98, 2.45)], 2.1, glass),
            boxes([[-1.0, 0, 2.2]], [[6.2, 2.4, 2.6]], box),
            boxes([[0, 0, 0.72]], [[8.2, 1.0, 0.3]], tyre),
            _wheels((-3.2, -2.1, 3.2), 0.48, 2.2, tyre),
        ]
    )


def _bus(paint: int, glass: int, tyre: int) -> Mesh:
    panes = boxes([[x, 0, 2.0] for x in np.linspace(-4.6, 4.6, 8)], [[1.15, 2.53, 0.85]], glass)
    front = boxes([[5.48, 0, 1.9]], [[0.06, 2.2, 1.2]], glass)
    return join_meshes(
        [
            boxes([[0, 0, 1.65]], [[11.0, 2.5, 2.5]], paint),
            panes,
            front,
            _wheels((-3.4, 3.6), 0.48, 2.3, tyre),
        ]
    )


def _extrude(outline_m: list[tuple[float, float]], width_m: float, material: int) -> Mesh:
    """Extrude an outline in x and z by half of width_m to each side."""
    return prism(outline_m, width_m, material).transform(rotation((1, 0, 0), 90)).translate(y=width_m / 2)


def _wheels(at_m: tuple[float, ...], radius_m: float, track_m: float, tyre: int) -> Mesh:
    centres = np.array([[x, y, radius_m] for x in at_m for y in (-track_m / 2, track_m / 2)])
    return tubes(centres - [0, 0.12, 0], centres + [0, 0.12, 0], radius_m, tyre, 14)
