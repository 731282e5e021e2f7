"""What a scene gives: a world, and where to see it from."""

from dataclasses import dataclass, field
from typing import NamedTuple

from stereoweave.synth.viewpoints import NEAREST_PX, Orbit
from stereoweave.synth.world import Fog, Material, Mesh, Sky, World


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A world and the places that a rig may stand at in it.

    Attributes:
        world: what is seen.
        orbit: where from.
        nearest_px: the disparity of the nearest surface in a picture 640 px wide, from..to.
        noise_levels: standard deviation of the cameras' noise in a white surface, in grey levels of 0..255.
    """

    world: World
    orbit: Orbit
    nearest_px: tuple[float, float] = NEAREST_PX
    noise_levels: float = 0.0


@dataclass
class Palette:
    """The materials of a scene while it is being built."""

    materials: list[Material] = field(default_factory=list)

    def add(self, material: Material) -> int:
        """Takes a material in; returns its index, for the meshes made of it."""
        self.materials.append(material)
        return len(self.materials) - 1


class Daylight(NamedTuple):
    """The light of a day: sky with sun, fog if any, and the exposure for both."""

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
    """A stage in daylight, its materials taken from the palette."""
    world = World(
        mesh=mesh,
        materials=tuple(palette.materials),
        sky=light.sky,
        fog=light.fog,
        exposure=light.exposure,
    )
    return Stage(world=world, orbit=orbit, nearest_px=nearest_px)
