"""Which input the covariance should depend on: time (the logarithm of the phase is the same) or the phase s.

CD over six made demonstrations of the tunnel task, against the truth of 300: error of the stiffness across the tunnel,
of the logarithm of the standard deviation, and how fast the stiffness changes. Medians over seeds.
"""

import argparse

import numpy as np
import torch

from torch_pbd import CholeskyCovRegressor
from torch_pbd.console import format_table
from torch_pbd.control import DMPController, StiffnessLaw
from torch_pbd.data import make_tunnel_demonstrations

RATE = 50.0  # Hz


def errors(controller, truth, n_steps):
    """Mean |dK|, mean |d log sd| and max |dK/dt| across the tunnel."""
    movements = controller.smooth(truth, n_steps)
    values = controller.varying(movements)
    residual = values - values.mean(axis=0)
    covariance = np.einsum("kti,ktj->tij", residual, residual) / (len(residual) - 1)
    law = StiffnessLaw().fitted(covariance)
    inferred = controller.covariance_.predict_cov(controller.reproduction_.phase(movements.time))
    stiffness, true_stiffness = law(inferred).numpy()[:, 0, 0], law(covariance).numpy()[:, 0, 0]
    dense = np.linspace(0.0, controller.duration_, 2001)
    served = law(controller.covariance_.predict_cov(controller.reproduction_.phase(dense))).numpy()[:, 0, 0]
    return (
        np.abs(stiffness - true_stiffness).mean(),
        0.5 * np.abs(np.log(inferred[:, 0, 0] / covariance[:, 0, 0])).mean(),
        np.abs(np.diff(served) / np.diff(dense)).max(),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n_seeds", type=int, default=10)
    n_seeds = parser.parse_args().n_seeds
    torch.set_num_threads(1)
    truth = make_tunnel_demonstrations(300, rate=RATE, random_state=1000)
    rows = []
    for variability in ("position", "forcing"):
        for n_steps in (11, 41, 100):
            for phase_input in ("time", "log_s", "s"):
                figures = []
                for seed in range(n_seeds):
                    shown = make_tunnel_demonstrations(6, rate=RATE, random_state=seed)
                    options = {"variability": variability, "phase_input": phase_input, "n_steps": n_steps}
                    figures.append(errors(DMPController(CholeskyCovRegressor(), **options).fit(shown), truth, n_steps))
                stiffness, scale, rate = (float(value) for value in np.median(figures, axis=0))
                rows.append(
                    options | {"mean |dK| [N/m]": stiffness, "mean |d log sd|": scale, "max |dK/dt| [N/m/s]": rate}
                )
    print(f"tunnel task, 6 demonstrations against 300, medians over {n_seeds} seeds\n")
    print(format_table(rows))


if __name__ == "__main__":
    main()
