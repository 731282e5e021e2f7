"""Views between and beyond the cameras: writes middle.png, wider.png (right of both) and wiggle.gif.

Run: python examples/new_views.py
"""

from pathlib import Path

import numpy as np

import stereoweave as sw
from stereoweave.io.animation import write_animation
from stereoweave.io.images import read_pair, write_image
from stereoweave.rendering.renderer import Renderer

HERE = Path(__file__).parent

pair = read_pair(HERE / "left.png", HERE / "right.png")
middle = sw.synthesize(pair.left, pair.right, position=0.5)
write_image("middle.png", middle.image)
print(f"seen by a camera: {100 * middle.drawn.mean():.1f} % of the middle view, the rest is filled in")

# Many views of one pair: match once, render any number of times.
estimate = sw.estimate(pair.left, pair.right, refined=True)
renderer = Renderer(pair, estimate)
write_image("wider.png", renderer.view(1.3).image)
there = np.linspace(0, 1, 6)
positions = [*there, *there[-2:0:-1]]
write_animation("wiggle.gif", (renderer.view(float(position)).image for position in positions), frame_ms=80)
