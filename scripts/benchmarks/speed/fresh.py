"""Work in a fresh process: what it costs to import, and how much memory it needs."""

import json
import os
import subprocess
import sys
import time
from typing import Any

# Linux resets the peak of a process that writes 5 there; elsewhere memory is not known.
_MEASURED = """
import json, time, warnings
from pathlib import Path
warnings.simplefilter("ignore")
import numpy as np, torch
import torch_pbd
torch.set_num_threads(1)
{setup}
def memory(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))
linux = Path("/proc/self/clear_refs").exists()
if linux:
    Path("/proc/self/clear_refs").write_text("5")
    before = memory("VmRSS")
start = time.process_time()
{work}
seconds = time.process_time() - start
print(json.dumps({{"seconds": seconds, "above": memory("VmHWM") - before if linux else float("nan")}}))
"""


def measured(setup: str, work: str) -> dict[str, float]:
    """CPU ``seconds`` of ``work`` after ``setup``, and how far its memory rose ``above`` that before it, in MiB."""
    result: dict[str, Any] = json.loads(_run(_MEASURED.format(setup=setup, work=work)).splitlines()[-1])
    return result


def measured_fit(model: str, data: str) -> tuple[float, str]:
    """CPU seconds of fitting a new ``model`` to ``demonstrations(data)``, and a note of its memory."""
    setup = (
        "from torch_pbd import CholeskyCovRegressor, HeteroscedasticGPRegressor\n"
        "from speed.made import demonstrations\n"
        f"X, y = demonstrations({data})\n{model}.fit(*demonstrations(20, 5))"
    )
    found = measured(setup, f"{model}.fit(X, y)")
    return found["seconds"], f"{found['above']:.0f} MiB above the data"


def wall_seconds(program: str) -> float:
    """Seconds that a fresh interpreter takes for a program, by the clock on the wall."""
    start = time.perf_counter()
    _run(program)
    return time.perf_counter() - start


def added_seconds(before: str, then: str) -> float:
    """CPU seconds that ``then`` takes in a fresh interpreter after ``before``."""
    clock = "start = time.process_time()"
    return float(_run(f"import time\n{before}\n{clock}\n{then}\nprint(time.process_time() - start)"))


def _run(program: str) -> str:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)  # finds what this process finds
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise RuntimeError(f"a program of the benchmark failed: {done.stderr.strip().splitlines()[-1:]}")
    return done.stdout
