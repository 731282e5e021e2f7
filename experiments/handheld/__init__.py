"""Hand-held-like stereo pairs with exact correspondences, to measure how well pairs are aligned."""
