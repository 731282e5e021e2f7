"""Depth in metres of a calibrated pair: prints it for the middle, and writes depth.png and disparity.png.

Run: python examples/depth_of_a_pair.py
"""

from pathlib import Path

import stereoweave as sw
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.io.images import write_image
from stereoweave.io.maps import write_depth_png

HERE = Path(__file__).parent

estimate = sw.estimate(HERE / "left.png", HERE / "right.png", calibration=HERE / "calib.txt")
assert estimate.pair and estimate.pair.camera
depth_m = estimate.pair.camera.depth_m(estimate.disparity_px)

height, width = depth_m.shape
print(f"in the middle: {depth_m[height // 2, width // 2]:.2f} m")
print(f"sure of {100 * (estimate.confidence > 0.5).mean():.0f} % of the pixels")

write_depth_png("depth.png", depth_m)  # 16 bits, millimetres
disparity_px = estimate.disparity_px
write_image("disparity.png", colour_disparity(disparity_px, find_colour_range_px(disparity_px)))
