"""Table I by scikit-learn's mixtures, from starts of their own: what docs/paper.md has beside ours."""

import numpy as np
from covariance_libraries import MixtureRegression

from torch_pbd.console import format_table
from torch_pbd.data import make_paper_simulation, paper_covariance
from torch_pbd.experiments.comparison import empirical_covariances
from torch_pbd.metrics import covariance_mse, relative_frobenius_error

if __name__ == "__main__":
    rows = []
    for reading in ("bell", "printed", "bowl"):
        for n_components in (5, 8):
            errors = []
            for seed in range(10):
                X, y, _ = make_paper_simulation(reading=reading, random_state=seed)
                inputs, empirical = empirical_covariances(X, y)
                found = MixtureRegression(n_components).fit(X, y).predict(inputs)[1]
                truth = paper_covariance(inputs, reading=reading)
                errors.append((covariance_mse(found, empirical), relative_frobenius_error(found, truth)))
            mse, error = map(float, np.median(errors, axis=0))
            rows.append({"reading": reading, "model": f"GMM {n_components}", "MSE": mse, "error to truth": error})
    print(format_table(rows))
