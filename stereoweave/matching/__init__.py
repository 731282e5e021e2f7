"""Stereo matching: estimates the disparity of a rectified pair."""
