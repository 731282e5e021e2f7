"""The page in a browser, and depth of a live camera."""
