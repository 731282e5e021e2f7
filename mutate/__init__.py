"""Mutation testing: small changes to the sources, each of which should make a test fail."""
