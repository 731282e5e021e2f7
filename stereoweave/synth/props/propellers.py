"""Random ship propellers: pitched and skewed blades with a round outline, on a hub."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.primitives import copies, lathe, loft, rotation, tubes
from stereoweave.synth.world import Mesh, join_meshes


@dataclass(frozen=True, kw_only=True)
class Propeller:
    """Ship propeller around the x axis, with aft at +x.

    Attributes:
        radius_m: distance from the axis to the tips.
        blades: number of blades.
        hub_share: radius of the hub as a fraction of radius_m.
        pitch_share: pitch as a fraction of the diameter.
        skew_deg: sweep of the tips around the axis.
        rake_m: aft lean of the tips.
        chord_m: greatest width of a blade.
        tip: bluntness of the tips, from 3 (slender) to 9 (blunt).
        hand: direction of rotation, 1 or -1.
    """

    radius_m: float
    blades: int
    hub_share: float
    pitch_share: float
    skew_deg: float
    rake_m: float
    chord_m: float
    tip: float
    hand: int

    @property
    def hub_m(self) -> float:
        """Radius of the hub."""
        return self.hub_share * self.radius_m

    @property
    def hub_half_m(self) -> float:
        """Half the length of the hub, which is long enough to cover the blade roots."""
        return 0.5 * 0.5 * self.chord_m * float(np.sin(self._pitch(self.hub_m))) + 0.08

    def sections_m(self, spans: int = 40, points: int = 32) -> Float[np.ndarray, "k m 3"]:
        """Return sections [K, M, 3] of one blade, from inside the hub to the tip.

        The sections are rings of points for `loft`.
        """
        # Sections are denser at the tip, because the outline is round there.
        span = np.sin(np.linspace(0, 0.992 * np.pi / 2, spans))[:, None]
        inner_m = 0.85 * self.hub_m
        radius = inner_m + (self.radius_m - inner_m) * span
        chord = self.chord_m * (0.5 + 0.5 * np.sin(np.pi / 2 * np.minimum(span / 0.65, 1)))
        chord = chord * np.sqrt(1 - span**self.tip)
        # The blade is thickest at the root, where it swells into the hub.
        thick = self.radius_m * (0.065 * (1 - span) + 0.007) * (1 + 0.9 * np.exp(-span / 0.07))
        thick = np.minimum(thick, 0.6 * chord)
        angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
        along, sine = np.cos(angle) / 2 * chord, np.sin(angle)
        off = thick / 2 * np.sign(sine) * np.abs(sine) ** 1.25 + 0.03 * chord * np.sin(angle) ** 2
        pitch = self._pitch(radius)
        skew = np.radians(self.skew_deg) * (span**2 - 0.3 * np.sin(np.pi * span))
        turned = skew + (along * np.cos(pitch) - off * np.sin(pitch)) / radius
        x = self.rake_m * span + along * np.sin(pitch) + off * np.cos(pitch)
        rings = np.stack([x, -self.hand * radius * np.sin(turned), radius * np.cos(turned)], -1)
        return rings[:, :: self.hand]

    def _pitch(self, radius_m: float | np.ndarray) -> float | np.ndarray:
        """Return the pitch angle of a blade at a radius, in radians."""
        return np.arctan(self.pitch_share * 2 * self.radius_m / (2 * np.pi * radius_m))


def draw_propeller(rng: np.random.Generator) -> Propeller:
    """Draw a random propeller with three to six blades, from narrow and straight to broad and swept."""
    blades = int(rng.choice([3, 4, 5, 6], p=[0.2, 0.4, 0.3, 0.1]))
    radius_m = rng.uniform(2.3, 2.8)
    return Propeller(
        radius_m=radius_m,
        blades=blades,
        hub_share=rng.uniform(0.16, 0.22),
        pitch_share=rng.uniform(0.75, 1.15),
        skew_deg=rng.uniform(8, 38),
        rake_m=rng.uniform(0, 0.12) * radius_m,
        chord_m=rng.uniform(2.0, 2.7) / blades * radius_m,
        tip=rng.uniform(3.5, 7),
        hand=int(rng.choice([-1, 1])),
    )


def propeller_mesh(propeller: Propeller, bronze: int, hub: int, bolt: int) -> Mesh:
    """Build a propeller centred on the origin, with its hub, cap and bolts; one blade points up."""
    blade = loft(propeller.sections_m(), bronze)
    # Planar texture coordinates keep the texture from being squeezed at the tip.
    blade = replace(blade, uv_m=blade.corners_m[..., 1:].copy())
    around = np.stack([rotation((1, 0, 0), k * 360 / propeller.blades) for k in range(propeller.blades)])
    return join_meshes([copies(blade, around), _hub(propeller, hub), _bolts(propeller, bolt)])


def turn_aft(mesh: Mesh) -> Mesh:
    """Rotate a mesh so that its z axis points aft, along +x."""
    return mesh.transform(rotation((0, 1, 0), 90))


def _hub(propeller: Propeller, material: int) -> Mesh:
    r, half = propeller.hub_m, propeller.hub_half_m
    ogive = np.linspace(0, 1, 9)[:, None]
    cap = np.concatenate([0.78 * r * np.sqrt(1 - ogive**2), half + 0.1 + 1.15 * r * ogive], 1)
    body = [
        (0, -half),
        (0.93 * r, -half),
        (0.99 * r, -0.4 * half),
        (r, 0),
        (0.97 * r, 0.6 * half),
        (0.9 * r, half),
    ]
    flange = [(0.86 * r, half + 0.015), (0.86 * r, half + 0.085), (0.79 * r, half + 0.1)]
    return turn_aft(lathe(np.concatenate([body, flange, cap]), material, sections=56))


def _bolts(propeller: Propeller, material: int) -> Mesh:
    """Build hexagonal bolts around the flange of the cap."""
    angle = np.arange(12) * np.pi / 6
    circle = np.stack([0 * angle, np.cos(angle), np.sin(angle)], -1)
    size = 0.055 * propeller.hub_m / 0.5
    start = circle * 0.82 * propeller.hub_m + [propeller.hub_half_m + 0.05, 0, 0]
    return tubes(start, start + [0.09, 0, 0], size, material, sides=6)
