"""The check of a release: what is in its files, and whether they install and run."""
