"""Synthetic stereo pairs with exact ground truth: scenes, textures, renderers and sets."""
