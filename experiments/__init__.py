"""Experiments behind the tables of this repository; not part of the package."""
