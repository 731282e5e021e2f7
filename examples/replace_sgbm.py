"""A program for OpenCV's StereoSGBM with the matcher replaced: writes points.npy, [N, 3] in metres.

Run: python examples/replace_sgbm.py
"""

from pathlib import Path

import cv2
import numpy as np

import stereoweave as sw

HERE = Path(__file__).parent

left, right = (cv2.imread(str(HERE / name)) for name in ("left.png", "right.png"))

# Was: matcher = cv2.StereoSGBM.create(minDisparity=0, numDisparities=64, blockSize=5, P1=600, P2=2400)
matcher = sw.StereoMatcher(minDisparity=0, numDisparities=64, blockSize=5, P1=600, P2=2400)

disparity_px = matcher.compute(left, right).astype(np.float32) / 16.0
known = disparity_px > matcher.getMinDisparity()
focal_px, baseline_m = 480.0, 0.406
to_points = np.array(
    [[1, 0, 0, -319.5], [0, 1, 0, -239.5], [0, 0, 0, focal_px], [0, 0, 1 / baseline_m, 0]], np.float32
)
points_m = cv2.reprojectImageTo3D(disparity_px, to_points)[known]
median_m = np.median(points_m[:, 2])
print(f"{100 * known.mean():.0f} % of the pixels have a point; half of them are beyond {median_m:.2f} m")
np.save("points.npy", points_m)
