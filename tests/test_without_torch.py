"""Where NumPy alone is installed: schedules of poses, their inertia and their files, and the loop that serves them."""

import json
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from control.test_schedule_poses import pose

import torch_pbd

__all__ = ["pose"]

USE = """
import importlib, json, sys
from importlib.util import find_spec
import numpy as np
from torch_pbd.control import RealTimeAdmittance, Schedule

saved = Schedule.load("saved.npz")
assert saved == Schedule.load("saved.json") == Schedule.load("saved.csv")
turned = saved.transform([0.5, 0.5, -0.5, 0.5]).retime(0.5).resample(100.0)
turned.with_inertia(lambda time: np.eye(6) * (1.0 + time[:, None, None])).save("turned.npz")
turned.diagonal()[0].save("diagonal.csv")

still = np.zeros((2, 2))
rows = np.stack([np.diag([100.0, 200.0])] * 2)
loop = RealTimeAdmittance(Schedule([0.0, 1.0], still, still, rows, 0.2 * rows, rows, [0.0, 1.0], mass=2.0))
loop.start(0.0)
for tick in range(1, 1000):
    loop.tick(tick / 1000, (1.0, 2.0))

for name in sys.argv[1:]:
    importlib.import_module(name)
there = [name for name in ("torch", "scipy", "sklearn", "matplotlib", "numpy", "torch_pbd") if find_spec(name)]
print(json.dumps({"there": there, "position": loop.position}))
"""


@pytest.fixture
def alone(tmp_path):
    """Folder of packages that has NumPy and this package, and nothing else."""
    folder = tmp_path / "packages"
    folder.mkdir()
    site = Path(np.__file__).parents[1]
    for package in (Path(torch_pbd.__file__).parent, *site.glob("numpy"), *site.glob("numpy.libs")):
        (folder / package.name).symlink_to(package, target_is_directory=True)
    return folder


def robots():
    """Modules of `torch_pbd.robots`, whose own libraries are asked for when a robot is."""
    package = Path(torch_pbd.__file__).parent / "robots"
    found = [f"torch_pbd.robots.{module.name}" for module in pkgutil.iter_modules([str(package)])]
    return ["torch_pbd.robots", *found] if package.is_dir() else []


def test_schedules_the_loop_and_the_adapters_need_numpy_alone(alone, tmp_path, pose):
    for suffix in ("npz", "json", "csv"):
        pose.save(tmp_path / f"saved.{suffix}")
    # -S leaves out the packages of this interpreter, so that the folder has all there are.
    command = [sys.executable, "-S", "-c", USE, *robots()]
    environment = {**os.environ, "PYTHONPATH": str(alone)}
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert told["there"] == ["numpy", "torch_pbd"]
    np.testing.assert_allclose(told["position"], [0.01, 0.01], rtol=1e-2)
    turned = pose.transform([0.5, 0.5, -0.5, 0.5]).retime(0.5).resample(100.0)
    made = torch_pbd.control.Schedule.load(tmp_path / "turned.npz")
    np.testing.assert_allclose(made.position, turned.position, rtol=1e-12)
    np.testing.assert_allclose(made.mass[:, 3, 3], 1.0 + turned.time, rtol=1e-12)
