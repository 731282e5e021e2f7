"""A fuzzer of everything that Stereoweave reads: `python -m fuzz --seconds 60`, or `make fuzz SECONDS=60`.

Valid files are damaged at random, and each is read as the package reads it. The only errors allowed are the
package's own; anything else is a finding: another exception, a warning, a crash, a hang, too much memory, for
the servers a status of 500 or no answer, and for the page a file of another visitor. Findings are kept in
`tests/corpus`, which `make test` reads again.
"""
