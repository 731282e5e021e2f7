"""Depth estimation for many pairs and videos, on this machine or on a Ray cluster."""
