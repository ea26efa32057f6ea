"""Figures of demonstrations, learned models, schedules and robot runs."""

from torch_pbd.plotting.display import MovementDisplay
from torch_pbd.plotting.parts import (
    plot_covariance_ellipses,
    plot_demonstrations,
    plot_model_bands,
    plot_rollout,
    plot_std_band,
    plot_stiffness,
)
from torch_pbd.plotting.poses import plot_arm, plot_covariance_ellipsoids, plot_frames
from torch_pbd.plotting.rerun import to_rerun
from torch_pbd.plotting.style import DATA, EMPIRICAL, FORCE, MODEL, OTHER, ROBOT, SERIES, TRUTH, legend_below

__all__ = [
    "DATA",
    "EMPIRICAL",
    "FORCE",
    "MODEL",
    "OTHER",
    "ROBOT",
    "SERIES",
    "TRUTH",
    "MovementDisplay",
    "legend_below",
    "plot_arm",
    "plot_covariance_ellipses",
    "plot_covariance_ellipsoids",
    "plot_demonstrations",
    "plot_frames",
    "plot_model_bands",
    "plot_rollout",
    "plot_std_band",
    "plot_stiffness",
    "to_rerun",
]
