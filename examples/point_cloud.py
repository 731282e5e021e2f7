"""Coloured point cloud and mesh in metres: writes points.ply and surface.glb; needs the extra 'mesh'.

Run: python examples/point_cloud.py
"""

from pathlib import Path

import stereoweave as sw
from stereoweave.cameras.calibration_files import add_camera
from stereoweave.io.images import read_pair
from stereoweave.outputs.point_cloud import make_mesh, make_point_cloud, write_glb, write_ply

HERE = Path(__file__).parent

pair = add_camera(read_pair(HERE / "left.png", HERE / "right.png"), HERE / "calib.txt")
estimate = sw.estimate(pair.left, pair.right)

# Uncertain pixels, and flying pixels between two surfaces, give no point.
cloud = make_point_cloud(pair, estimate, least_confidence=0.7)
near_m, far_m = cloud.points_m[:, 2].min(), cloud.points_m[:, 2].max()
print(f"{len(cloud.points_m)} points, {near_m:.2f} to {far_m:.2f} m away")
write_ply("points.ply", cloud)
write_glb("surface.glb", make_mesh(pair, estimate))
