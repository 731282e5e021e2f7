"""Objects that scenes are composed of."""
