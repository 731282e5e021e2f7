"""Export of trained networks as matcher files."""
