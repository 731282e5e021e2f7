"""Stereo videos: reading, converting, writing."""
