"""Measurement of the time that each rendering effect takes."""

import time
from dataclasses import dataclass, replace

from stereoweave.synth.rendering.effects import PLAIN, Effects
from stereoweave.synth.rendering.opengl import OpenGLRenderer
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_stage_and_rig
from stereoweave.synth.viewpoints import PosedRig
from stereoweave.synth.world import World

_OFF = {
    "shadows": replace(Effects(), shadows=False),
    "ambient occlusion": replace(Effects(), ambient_occlusion=False),
    "gloss": replace(Effects(), gloss=False),
    "fog": replace(Effects(), fog=False),
    "relief": replace(Effects(), relief=False),
    "2x2 samples": replace(Effects(), samples=1),
}


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Rendering time of a pair on one core, in milliseconds: the share of one effect, or a total."""

    effect: str
    ms_a_pair: float


def measure_effect_costs(
    scene: str = "propeller", pairs: int = 3, size_px: tuple[int, int] = (640, 480)
) -> list[Cost]:
    """Measure the time with all effects, the share of each effect, and the time without effects.

    The time for building the scene is excluded.
    """
    spec = RenderSpec(scene=scene, size_px=size_px)
    renderer = OpenGLRenderer(PLAIN)
    stages = [draw_stage_and_rig(renderer, spec, index) for index in range(pairs)]
    renderer.close()
    views = [(stage.world, rig) for stage, rig in stages]
    everything_ms = _ms_a_pair(Effects(), views)
    return [
        Cost(effect="everything", ms_a_pair=everything_ms),
        *(
            Cost(effect=name, ms_a_pair=everything_ms - _ms_a_pair(rest, views))
            for name, rest in _OFF.items()
        ),
        Cost(effect="none (plain)", ms_a_pair=_ms_a_pair(PLAIN, views)),
    ]


def _ms_a_pair(effects: Effects, views: list[tuple[World, PosedRig]]) -> float:
    """Return the mean time per pair in ms, using the faster of two runs for each pair.

    Each run renders a world that is new to the renderer, so nothing is cached.
    """
    renderer = OpenGLRenderer(effects)
    renderer.render_views(*views[0], (0.0, 1.0))
    total_s = 0.0
    for world, rig in views:
        tries = []
        for _ in range(2):
            fresh, start = replace(world), time.process_time()
            renderer.render_views(fresh, rig, (0.0, 1.0))
            tries.append(time.process_time() - start)
        total_s += min(tries)
    renderer.close()
    return 1e3 * total_s / len(views)
