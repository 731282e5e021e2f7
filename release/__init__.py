"""Release checks: contents of the release files, installation and a trial run."""
