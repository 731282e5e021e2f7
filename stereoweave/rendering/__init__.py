"""View synthesis from an estimate."""
