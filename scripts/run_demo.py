"""``torch-pbd demo`` as a script: ``python scripts/run_demo.py --config FILE``."""

import sys

from torch_pbd.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["demo", *sys.argv[1:]]))
