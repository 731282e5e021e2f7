"""Scores of disparity, new views and flicker against ground truth."""
