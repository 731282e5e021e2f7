"""Fuzzer for everything that Stereoweave reads: `python -m fuzz --seconds 60`, or `make fuzz SECONDS=60`.

It damages valid files at random and reads them as the package does. The package's own errors are allowed.
Anything else is a finding: another exception, a warning, a crash, a hang, or excessive memory use. For the
servers, a status of 500 or a missing response is also a finding, and for the page, access to another
visitor's file. Findings are stored in `tests/corpus`, and `make test` reads them again.
"""
