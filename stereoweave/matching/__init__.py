"""Stereo matching: estimation of the disparity of a rectified pair."""
