"""The web page, and depth from a live camera."""
