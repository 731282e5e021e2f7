"""Ship hulls: painted skins, decks, and the points on both where fittings are attached."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.primitives import sheet, sweep
from stereoweave.synth.world import Mesh, join_meshes

Values = float | np.ndarray


@dataclass(frozen=True, kw_only=True)
class Hull:
    """Hull with its bow at +x and its waterline at z = 0.

    Attributes:
        length_m: length at the waterline, from x = -length_m / 2 to x = length_m / 2.
        beam_m: greatest breadth of the deck.
        draft_m: depth of the keel below the waterline.
        freeboard_m: height of the bulwark's edge amidships.
        sheer_m: additional height of the bulwark's edge at the stern and at the bow.
        stern: breadth of the transom as a fraction of the beam.
        rise: rise of the keel at the stern as a fraction of the draft.
        rise_to: fraction of the length, measured from the stern, over which the keel rises.
        rake_m: forward lean of the stem.
        bulwark_m: height of the bulwark above the deck.
    """

    length_m: float
    beam_m: float
    draft_m: float
    freeboard_m: float
    sheer_m: tuple[float, float] = (0.1, 0.5)
    stern: float = 0.75
    rise: float = 0.4
    rise_to: float = 0.3
    rake_m: float = 0.6
    bulwark_m: float = 0.25

    def edge_m(self, share: Values) -> Values:
        """Return the height of the bulwark's edge at a fraction of the length, from 0 (stern) to 1 (bow)."""
        aft, forward = np.clip((0.4 - share) / 0.4, 0, 1), np.clip((share - 0.4) / 0.6, 0, 1)
        return self.freeboard_m + self.sheer_m[0] * aft**2 + self.sheer_m[1] * forward**2

    def deck_m(self, x: float) -> float:
        """Return the height of the deck at x."""
        return float(self.edge_m(x / self.length_m + 0.5)) - self.bulwark_m

    def keel_m(self, share: Values) -> Values:
        """Return the height of the keel, a negative number, at a fraction of the length."""
        aft = np.clip(1.35 - 1.35 * share / self.rise_to, 0, 1)
        return -self.draft_m * (1 - self.rise * aft * aft * (3 - 2 * aft))

    def side_m(self, share: Values, z: Values, side: Values) -> Float[np.ndarray, "... 3"]:
        """Return points on the skin at the given fractions of the length and heights.

        side: 1 for port (+y), -1 for starboard.
        """
        share, z, side = np.broadcast_arrays(share, z, side)
        keel = self.keel_m(share)
        level = np.clip((z - keel) / (self.edge_m(share) - keel), 0, 1.2)
        aft, forward = np.clip((0.4 - share) / 0.4, 0, 1), np.clip((share - 0.45) / 0.55, 0, 1)
        plan = (1 - (1 - self.stern) * aft**2) * np.maximum(1 - forward**2.4, 0) ** 0.8
        # Sections are U-shaped amidships, and V-shaped with flare at the bow.
        y = (self.beam_m / 2 * plan) * level ** (0.2 + 0.25 * aft + 0.75 * forward**1.5) + 0.02
        x = self.length_m * (share - 0.5) + self.rake_m * level**1.3 * forward**2
        x = x - 0.35 * self.rake_m * level * aft**3
        return np.stack([x, side * y, z], -1)

    def skin(self, bottom: int, stripe: int, topside: int, stripe_m: float = 0.12) -> Mesh:
        """Build the outside of the hull and the transom, with a painted stripe above the waterline."""
        share, dry = self._topside(stripe_m)
        wet = self.keel_m(share) * (1 - np.linspace(0, 1, 10) ** 3)
        z = np.concatenate([wet, dry], 1)
        port, starboard = (self.side_m(share, z, side) for side in (1, -1))
        middle = port[:, :1] * [1, 0, 1]
        skin = sheet(np.concatenate([port[:, ::-1], middle, starboard], 1)[:, ::-1], topside)
        paint = np.full(z.shape[1], topside)
        paint[:10], paint[10] = bottom, stripe
        cells = np.concatenate([paint[:0:-1], [bottom, bottom], paint[1:]])
        material = np.broadcast_to(cells[None, :, None], (60, len(cells), 2)).ravel()
        return join_meshes([replace(skin, material=material.astype(np.int32)), self._transom(z[0], paint)])

    def deck(self, planks: int, inside: int, rail: int) -> Mesh:
        """Build the deck, the inside of the bulwark and the rail on its edge."""
        share = np.linspace(0, 0.985, 41)
        edge = self.edge_m(share)
        port, starboard = (self.side_m(share, edge - self.bulwark_m, side) for side in (1, -1))
        across = np.linspace(0.02, 0.98, 9)[None, :, None]
        floor = sheet((starboard[:, None] + across * (port - starboard)[:, None]).swapaxes(0, 1), planks)
        walls, rails = [], []
        for side in (1, -1):
            foot, top = (
                self.side_m(share, edge - drop, side) * [1, 0.985, 1] for drop in (self.bulwark_m, 0)
            )
            walls.append(sheet(np.stack([foot, top])[::side], inside))
            rails.append(sweep(self.side_m(share, edge, side), 0.022, rail, sides=6))
        return join_meshes([floor, *walls, *rails])

    def patch(self, stations: tuple[int, int], levels: tuple[int, int], side: int, material: int) -> Mesh:
        """Build a plate on the skin above the stripe.

        Above the stripe, the skin is a grid of 60 cells along the hull by 7 cells in height. The plate covers
        the cells in the ranges `stations` (along the hull) and `levels` (in height).
        """
        share, z = self._topside(0.12)
        cells = np.s_[stations[0] : stations[1] + 1, levels[0] : levels[1] + 1]
        points = self.side_m(np.broadcast_to(share, z.shape)[cells], z[cells], side)
        # The plate uses the skin's own vertices, so it never sinks below the skin.
        plate = sheet(points[:, ::side], material)
        uv = side * np.stack([-plate.uv_m[..., 1], plate.uv_m[..., 0]], -1)
        outside = plate.corners_m + np.float32(0.012) * plate.normals
        return replace(plate, corners_m=outside, uv_m=uv - uv.min((0, 1)))

    def _topside(self, stripe_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the grid points of the skin above the stripe.

        The points are given as fractions of the length [61, 1] and as heights [61, 8] from the stripe to the
        edge of the bulwark.
        """
        share = np.linspace(0, 1, 61)[:, None]
        return share, stripe_m + (self.edge_m(share) - stripe_m) * np.linspace(0, 1, 8)

    def _transom(self, z: np.ndarray, paint: np.ndarray) -> Mesh:
        port, starboard = (self.side_m(np.zeros(len(z)), z, side) for side in (1, -1))
        flat = sheet(np.stack([port, starboard], 1), 0)
        return replace(flat, material=np.repeat(paint[1:], 2).astype(np.int32))
