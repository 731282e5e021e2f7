"""From files to a pair."""
