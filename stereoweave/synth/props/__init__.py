"""The things of which scenes are made."""
