"""``torch-pbd compare`` as a script: ``python scripts/run_compare.py --config FILE``."""

import sys

from torch_pbd.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
