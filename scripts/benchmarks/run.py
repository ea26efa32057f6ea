"""``torch-pbd benchmark`` as a script: ``python scripts/benchmarks/run.py --groups fitting,growth``."""

import sys

from torch_pbd.cli import main

if __name__ == "__main__":
    sys.exit(main(["benchmark", *sys.argv[1:]]))
