"""Stereo matching: from a pair to an estimate."""
