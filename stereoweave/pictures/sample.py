"""The pair that ships with the package: a rendered ship and its calibration."""

import importlib.resources
from pathlib import Path


def sample_folder() -> Path:
    """Return the folder that contains left.jpg, right.jpg and calib.txt."""
    return Path(str(importlib.resources.files("stereoweave"))) / "sample"
