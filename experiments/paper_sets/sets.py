"""The sets that sets.toml lists."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

from stereoweave.synth.sets.pair_rendering import RenderSpec

# Width of the paper's pictures, for which the focal lengths are given.
_WIDTH_PX = 640


@dataclass(frozen=True, kw_only=True)
class PaperSet:
    """A set by world.

    Attributes:
        scene: Name of the scene.
        seed: Seed of all random numbers.
        worlds: Number of worlds.
        frames: Number of pairs of each world.
        focal_px: Focal length for pictures 640 px wide.
        baseline_m: Distance between the two cameras.
        distance_m: Least and greatest distance of the cameras from the target's centre; None for the scene's.
    """

    scene: str
    seed: int
    worlds: int
    frames: int
    focal_px: float
    baseline_m: float
    distance_m: tuple[float, float] | None = None

    @property
    def pairs(self) -> int:
        """Number of pairs of the set."""
        return self.worlds * self.frames

    def spec(self, size_px: tuple[int, int]) -> RenderSpec:
        """Return the specification of the pairs at a size in pixels."""
        return RenderSpec(
            scene=self.scene,
            seed=self.seed,
            size_px=size_px,
            frames=self.frames,
            rig=(self._focal_px(size_px), self.baseline_m),
            by_world=True,
            distance_m=self.distance_m,
        )

    def command(self, size_px: tuple[int, int], out: str) -> str:
        """Return the command line that makes the set in a folder."""
        near_and_far = f" --distance {self.distance_m[0]:g} {self.distance_m[1]:g}" if self.distance_m else ""
        return (
            f"stereoweave synth make {self.scene} --worlds {self.worlds} --frames {self.frames} "
            f"--seed {self.seed} --size {size_px[0]}x{size_px[1]} --rig {self._focal_px(size_px):g} "
            f"{self.baseline_m:g}{near_and_far} --layout paper -o {out}"
        )

    def _focal_px(self, size_px: tuple[int, int]) -> float:
        return self.focal_px * size_px[0] / _WIDTH_PX


def read_sets() -> list[PaperSet]:
    """Return the sets in the order of sets.toml."""
    tables = tomllib.loads(Path(__file__).with_name("sets.toml").read_text(encoding="utf-8"))
    sets = []
    for scene, table in tables.items():
        distance_m = tuple(table.pop("distance_m")) if "distance_m" in table else None
        sets.append(PaperSet(scene=scene, distance_m=distance_m, **table))
    return sets
