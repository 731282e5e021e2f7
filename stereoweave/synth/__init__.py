"""Synthetic stereo with exact ground truth: scenes, textures, renderers, and sets of pairs."""
