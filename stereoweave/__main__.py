"""Entry point of `python -m stereoweave`, through which torchrun starts a training."""

import sys

from stereoweave.cli.root import main

if __name__ == "__main__":
    sys.exit(main())
