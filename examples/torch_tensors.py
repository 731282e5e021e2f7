"""Tensors in, tensors out: disparity as an input of your own network; writes features.pt. Needs PyTorch.

Run: python examples/torch_tensors.py
"""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

import stereoweave as sw

HERE = Path(__file__).parent

# The form that data loaders return: float in 0..1, channels first, with a batch of one.
left, right = (
    torch.from_numpy(np.array(Image.open(HERE / name))).permute(2, 0, 1)[None] / 255
    for name in ("left.png", "right.png")
)
estimate = sw.estimate(left, right)
disparity_px = torch.from_numpy(estimate.disparity_px)[None, None]
confidence = torch.from_numpy(estimate.confidence)[None, None]

features = torch.cat([left, disparity_px, confidence], dim=1)
print(f"features {list(features.shape)}, disparity {disparity_px.min():.1f} to {disparity_px.max():.1f} px")
torch.save(features, "features.pt")
