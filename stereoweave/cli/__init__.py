"""The command line: only commands and their options."""
