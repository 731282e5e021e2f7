"""From a checkpoint to a matcher file."""
