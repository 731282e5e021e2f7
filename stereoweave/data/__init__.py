"""Datasets: stereo pairs with ground truth."""
