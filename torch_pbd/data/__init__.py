"""Demonstrations: container, files, alignment and synthetic data."""

from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.description import check_unimodal
from torch_pbd.data.io import inspect_demonstrations, load_demonstrations, save_demonstrations
from torch_pbd.data.synthetic import (
    make_paper_simulation,
    make_tunnel_demonstrations,
    paper_covariance,
    paper_mean,
    tunnel_center,
    tunnel_half_width,
)
from torch_pbd.data.via_points import (
    handwriting_covariance,
    handwriting_mean,
    make_handwriting_demonstrations,
    make_pose_demonstrations,
    pose_covariance,
    pose_mean,
)

__all__ = ["Demonstrations", "check_unimodal", "inspect_demonstrations", "load_demonstrations", "save_demonstrations"]
# Made data, each with the law that it is drawn from.
__all__ += ["make_paper_simulation", "paper_covariance", "paper_mean"]
__all__ += ["make_tunnel_demonstrations", "tunnel_center", "tunnel_half_width"]
__all__ += ["handwriting_covariance", "handwriting_mean", "make_handwriting_demonstrations"]
__all__ += ["make_pose_demonstrations", "pose_covariance", "pose_mean"]
