"""Stages: worlds with the viewpoints from which they are rendered."""

from dataclasses import dataclass, field
from typing import NamedTuple

from stereoweave.synth.viewpoints import NEAREST_PX, Orbit
from stereoweave.synth.world import Fog, Material, Mesh, Sky, World


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A world with the viewpoints from which it is rendered.

    Attributes:
        world: Everything that the cameras see.
        orbit: Range of the viewpoints.
        nearest_px: Range of the nearest surface's disparity in an image 640 px wide.
        noise_levels: Standard deviation of the sensor noise in white areas, in grey levels (0..255).
    """

    world: World
    orbit: Orbit
    nearest_px: tuple[float, float] = NEAREST_PX
    noise_levels: float = 0.0


@dataclass
class Palette:
    """The materials of a scene that is being built."""

    materials: list[Material] = field(default_factory=list)

    def add(self, material: Material) -> int:
        """Add a material and return the index by which meshes refer to it."""
        self.materials.append(material)
        return len(self.materials) - 1


class Daylight(NamedTuple):
    """Outdoor light: the sky with its sun, optional fog, and a suitable exposure."""

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
    """Build an outdoor stage from a mesh, the palette of its materials, daylight and an orbit."""
    world = World(
        mesh=mesh,
        materials=tuple(palette.materials),
        sky=light.sky,
        fog=light.fog,
        exposure=light.exposure,
    )
    return Stage(world=world, orbit=orbit, nearest_px=nearest_px)
