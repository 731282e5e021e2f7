"""`python -m stereoweave`, which is how torchrun starts a training: the commands."""

import sys

from stereoweave.cli.root import main

if __name__ == "__main__":
    sys.exit(main())
