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

__all__ = ["MovementDisplay", "to_rerun"]
# Parts of figures, over time and in space, and the colours of what they show.
__all__ += ["plot_covariance_ellipses", "plot_demonstrations", "plot_model_bands", "plot_rollout", "plot_std_band"]
__all__ += ["legend_below", "plot_arm", "plot_covariance_ellipsoids", "plot_frames", "plot_stiffness"]
__all__ += ["DATA", "EMPIRICAL", "FORCE", "MODEL", "OTHER", "ROBOT", "SERIES", "TRUTH"]
