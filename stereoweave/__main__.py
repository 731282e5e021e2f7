"""Entry point of `python -m stereoweave`; torchrun starts a training this way."""

import sys

from stereoweave.cli.root import main

if __name__ == "__main__":
    sys.exit(main())
