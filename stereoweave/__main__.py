"""Entry point of `python -m stereoweave`, which torchrun uses to start training."""

import sys

from stereoweave.cli.root import main

if __name__ == "__main__":
    sys.exit(main())
