"""Distance in metres between the points that two pixels show, with its uncertainty.

Run: python examples/measure.py
or, with column and row of two pixels: python examples/measure.py 130 380 440 225
"""

import sys
from pathlib import Path

import stereoweave as sw
from stereoweave.cameras.calibration_files import add_camera
from stereoweave.io.images import read_pair
from stereoweave.outputs.measure import CameraError, distance

HERE = Path(__file__).parent

column, row, other_column, other_row = map(int, sys.argv[1:] or (262, 225, 390, 215))
pair = add_camera(read_pair(HERE / "left.png", HERE / "right.png"), HERE / "calib.txt")
assert pair.camera is not None
found = distance(
    sw.estimate(pair.left, pair.right, model="base"),
    pair.camera,
    (column, row),
    (other_column, other_row),
    # The baseline is known to half a percent.
    camera_error=CameraError(baseline=0.005),
)
print(f"from ({column}, {row}) to ({other_column}, {other_row}): {found}")
