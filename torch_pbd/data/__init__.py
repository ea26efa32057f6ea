"""Demonstrations: the container, files, alignment, and made ones."""

from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.handwriting import handwriting_covariance, handwriting_mean, make_handwriting_demonstrations
from torch_pbd.data.io import inspect_demonstrations, load_demonstrations, save_demonstrations
from torch_pbd.data.peg import make_pose_demonstrations, pose_covariance, pose_mean
from torch_pbd.data.synthetic import (
    make_paper_simulation,
    make_tunnel_demonstrations,
    paper_covariance,
    paper_mean,
    tunnel_center,
    tunnel_deviation,
    tunnel_half_width,
)
from torch_pbd.data.unimodality import check_unimodal

__all__ = [
    "Demonstrations",
    "check_unimodal",
    "handwriting_covariance",
    "handwriting_mean",
    "inspect_demonstrations",
    "load_demonstrations",
    "make_handwriting_demonstrations",
    "make_paper_simulation",
    "make_pose_demonstrations",
    "make_tunnel_demonstrations",
    "paper_covariance",
    "paper_mean",
    "pose_covariance",
    "pose_mean",
    "save_demonstrations",
    "tunnel_center",
    "tunnel_deviation",
    "tunnel_half_width",
]
