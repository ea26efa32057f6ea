"""How far covariances are from singular, and what units and origins change: 1,000 random fits x 1,000 inputs.

``PYTHONPATH=tests python -m reliability`` takes about ten minutes on one core; ``--n_jobs 2`` half of it. A seed in the
table is one problem: ``random_recipe(seed, most_steps=20, most_outputs=4).data()``, fitted by
``candidate(name, seed, X)``.

The eigenvalues are the smallest of the covariances scaled to unit variances, and the smallest over the largest of the
covariances in the units in which a model computes: both are blind to the units of the data, and should not be below
1e-12. Inputs up to a million ranges away and at 1e300 are among those predicted at. Then differences of predictions
with y and X in other units (factors of 1e-9 to 1e9 for each column), and from another origin: the mean's in deviations
of the data, an entry of the covariance over the predicted deviations it belongs to, of which none counts for less than
1e-4 (with origins 1e-3) of that in the data: a float64 has no more digits.
"""

import argparse
import time

from reliability.report import measure_all, table, told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n_fits", type=int, default=1000)
    parser.add_argument("--n_inputs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the first fit; they count up from it")
    parser.add_argument("--n_jobs", type=int, default=1)
    options = parser.parse_args()
    start = time.monotonic()
    results = measure_all(options.n_fits, options.n_inputs, seed=options.seed, n_jobs=options.n_jobs)
    print(f"{options.n_fits} fits x {options.n_inputs} inputs, seeds from {options.seed}:")
    columns = table(results)
    for key in columns[0]:
        print(f"  {key:>28}  " + "  ".join(f"{row[key]:>15}" for row in columns))
    print("\n".join(told(results)))
    print(f"{time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
