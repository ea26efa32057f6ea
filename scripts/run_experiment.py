"""``torch-pbd experiment`` as a script: ``python scripts/run_experiment.py --config FILE``."""

import sys

from torch_pbd.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["experiment", *sys.argv[1:]]))
