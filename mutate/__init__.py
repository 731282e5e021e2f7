"""Mutation testing: small changes of the sources, each of which a test should notice."""
