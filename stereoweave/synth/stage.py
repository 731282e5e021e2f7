"""Stages, which scenes return: a world and the viewpoints on it."""

from dataclasses import dataclass, field
from typing import NamedTuple

from stereoweave.synth.viewpoints import NEAREST_PX, Orbit
from stereoweave.synth.world import Fog, Material, Mesh, Sky, World


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A world and the viewpoints on it.

    Attributes:
        world: what the cameras see.
        orbit: the viewpoints.
        nearest_px: range of the nearest surface's disparity in a picture 640 px wide.
        noise_levels: standard deviation of the sensor noise on white, in grey levels of 0..255.
    """

    world: World
    orbit: Orbit
    nearest_px: tuple[float, float] = NEAREST_PX
    noise_levels: float = 0.0


@dataclass
class Palette:
    """The materials of a scene under construction."""

    materials: list[Material] = field(default_factory=list)

    def add(self, material: Material) -> int:
        """Add a material. Returns its index, which meshes refer to."""
        self.materials.append(material)
        return len(self.materials) - 1


class Daylight(NamedTuple):
    """Outdoor light: sky with sun, fog (or None), and the exposure for them."""

    sky: Sky
    fog: Fog | None
    exposure: float


def outdoor_stage(
    mesh: Mesh,
    palette: Palette,
    light: Daylight,
    orbit: Orbit,
    nearest_px: tuple[float, float] = NEAREST_PX,
) -> Stage:
    """Build an outdoor stage with the materials of a palette."""
    world = World(
        mesh=mesh,
        materials=tuple(palette.materials),
        sky=light.sky,
        fog=light.fog,
        exposure=light.exposure,
    )
    return Stage(world=world, orbit=orbit, nearest_px=nearest_px)
