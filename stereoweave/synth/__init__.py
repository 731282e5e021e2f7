"""Synthetic stereo with exact ground truth: scenes, textures, and the renderer."""
