"""Depths as users read them."""

import math

# Of what is farther, no rig measures the depth; a disparity slightly above 0 would give 367,134 m.
FARTHEST_M = 10_000


def format_metres(depth_m: float | None) -> str:
    """Return a depth with its unit, to three digits; "infinity" for None and for infinity."""
    if depth_m is None or math.isinf(depth_m):
        return "infinity"
    if depth_m >= FARTHEST_M:
        return f"over {FARTHEST_M / 1000:g} km"
    return f"{depth_m:#.3g} m" if depth_m < 99.95 else f"{depth_m:.0f} m"
