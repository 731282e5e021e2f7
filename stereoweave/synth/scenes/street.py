"""Scene `street`: a street seen from a car."""

import numpy as np

from stereoweave.synth.props.streets import (
    carriageway,
    draw_street_plan,
    fronts,
    street_furniture,
    traffic,
    walkers,
)
from stereoweave.synth.props.surroundings import daylight, hills, terrain
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import join_meshes

# The nearest surface is the road in front of the car.
_NEAREST_PX = (25.0, 130.0)


def street(rng: np.random.Generator) -> Stage:
    """Build a street along x with houses, vehicles, people and posts, seen from 1.2 to 2 m above a lane."""
    palette, plan = Palette(), draw_street_plan(rng)
    target = join_meshes([traffic(rng, palette, plan), walkers(rng, palette, plan)]).as_target()
    parts = [
        carriageway(rng, palette, plan),
        fronts(rng, palette, plan),
        street_furniture(rng, palette, plan),
        terrain(rng, palette, "grass", extent_m=180.0, level_m=-0.1, bumps_m=0.0),
    ]
    if rng.random() < 0.5:
        parts.append(hills(rng, palette, distance_m=160.0))
    light = daylight(rng)
    mesh = join_meshes([target, *parts])
    turned_deg = float(rng.normal(180.0, 3.0))
    orbit = Orbit(
        centre_m=(0.0, plan.lane_m, rng.uniform(1.2, 1.6)),
        distance_m=(9.0, 14.0),
        azimuth_deg=(turned_deg - 2, turned_deg + 2),
        elevation_deg=(0.0, 1.6),
        aim_m=1.2,
    )
    return outdoor_stage(mesh, palette, light, orbit, nearest_px=_NEAREST_PX)
