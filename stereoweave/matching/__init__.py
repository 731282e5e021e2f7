"""From a pair to an estimate."""
