"""Shapes of the torch floors are checked while the tests run; fixtures that several folders share."""

import os
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: threads only wait for each other

import shapes

TORCH_CONTROL = [
    "matrices", "stiffness", "primitive.dmp", "stability.certify",
    *(f"stability.{part}" for part in ("common_function", "dynamics", "lyapunov")),
    *(f"simulation.{part}" for part in ("walls", "plant", "sensor", "rollout", "rollouts", "ticks")),
]  # fmt: skip
TORCH_MOVEMENT = [f"movement.{part}" for part in ("joint", "output_kernel", "time_kernel", "time_kernel_fit", "timing")]
TORCH_FLOORS = [
    "linalg",
    "kernels",
    "optim",
    "gp",
    "models",
    *TORCH_MOVEMENT,
    *(f"control.{part}" for part in TORCH_CONTROL),
]
shapes.install([f"torch_pbd.{floor}" for floor in TORCH_FLOORS])

import numpy as np  # noqa: E402 - the hook must come first
import pytest  # noqa: E402
import torch  # noqa: E402
from hypothesis import settings  # noqa: E402

settings.register_profile("thorough", print_blob=True)
torch.set_num_threads(1)


def pytest_configure(config):
    # A worker that has no test left takes some of the other's: the longest files would leave one idle for a minute.
    if getattr(config.option, "dist", "no") == "load":
        config.option.dist = "worksteal"


def pytest_runtest_setup(item):
    shapes.begin_test(slow=item.get_closest_marker("slow") is not None)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def recordings():
    """Folder of recorded human demonstrations, beside a development checkout; skipped where absent."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TORCH_PBD_DATA", default))
    if not (folder / "letter_G.npz").is_file():
        pytest.skip("no recorded demonstrations here; set TORCH_PBD_DATA to a folder that has them")
    return folder
