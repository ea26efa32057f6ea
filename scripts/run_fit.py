"""``torch-pbd fit`` as a script: ``python scripts/run_fit.py --config FILE``."""

import sys

from torch_pbd.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["fit", *sys.argv[1:]]))
