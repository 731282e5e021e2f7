"""Simulated hand-held stereo pairs with exact correspondences, for measuring how well pairs are aligned."""
