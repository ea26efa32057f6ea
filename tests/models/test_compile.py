"""``torch.compile`` of fitted modules; in processes of their own, for there shapes are not checked in passing."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

PROGRAM = """
import json, warnings
import torch
import torch_pbd
from torch_pbd.data import make_paper_simulation

warnings.simplefilter("ignore")  # what the compiler uses of torch is deprecated
torch.set_num_threads(1)
X, y, _ = make_paper_simulation(5, 20, random_state=0)
x = torch.linspace(-20.0, 220.0, 7, dtype=torch.float64)[:, None]
found = []
for name in ("CholeskyCovRegressor", "WishartProcessRegressor", "GMMBaseline", "HeteroscedasticGPRegressor"):
    module = getattr(torch_pbd, name)().fit(X, y).module_
    compiled = torch.compile(module)
    for guard in (torch.no_grad, torch.inference_mode):
        with guard():
            found.append([part.tolist() for part in (*compiled(x), *module(x))])
print(json.dumps(found))
"""


@pytest.mark.slow
def test_a_compiled_module_gives_what_the_module_does(tmp_path):
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache"), "TMPDIR": str(tmp_path)}
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    found = json.loads(ran.stdout.splitlines()[-1])
    assert len(found) == 8
    for compiled_mean, compiled_tril, mean, scale_tril in found:
        scale = np.linalg.norm(scale_tril, axis=-1)
        np.testing.assert_allclose((np.array(compiled_mean) - mean) / scale, 0.0, atol=1e-12)
        np.testing.assert_allclose((np.array(compiled_tril) - scale_tril) / scale[:, :, np.newaxis], 0.0, atol=1e-12)
