"""Every comparison of speed in one run, five to ten minutes: ``python scripts/benchmarks/run_speed.py``."""

import argparse

import matplotlib as mpl
from speed import GROUPS, run_benchmark

from torch_pbd.experiments.run_folder import RunFolder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", nargs="+", choices=list(GROUPS), default=list(GROUPS), help="what to compare")
    parser.add_argument("--n_repetitions", type=int, default=5, help="of each contender")
    parser.add_argument("--quick", action="store_true", help="small sizes, once, to see that everything runs")
    parser.add_argument("--output", default="runs/speed", help="folder of the results")
    options = parser.parse_args()
    mpl.use("Agg")
    with RunFolder(options.output, vars(options)) as folder:
        print(run_benchmark(folder, options.groups, n_repetitions=options.n_repetitions, quick=options.quick))
        print(f"\nresults: {folder.path}")


if __name__ == "__main__":
    main()
