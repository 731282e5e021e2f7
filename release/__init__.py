"""Check of a release: the contents of its files, and whether they install and run."""
