"""Fuzzer for everything that Stereoweave reads: `python -m fuzz --seconds 60`, or `make fuzz SECONDS=60`.

It damages valid files at random and reads them as the package does. The package's own errors are allowed;
anything else is a finding: another exception, a warning, a crash, a hang, too much memory; for the servers
also a status of 500 or no response, and for the page another visitor's file. Findings are stored in
`tests/corpus`, which `make test` reads again.
"""
