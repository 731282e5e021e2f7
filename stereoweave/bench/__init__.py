"""Scores: of disparity, of views, of flicker, against ground truth."""
