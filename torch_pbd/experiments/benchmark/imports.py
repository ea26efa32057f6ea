"""What importing the package and asking the command line for help take."""

from torch_pbd.experiments.benchmark.fresh import cpu_seconds, wall_seconds
from torch_pbd.experiments.benchmark.rows import Findings, Plan, Row

_NAMES = "torch_pbd.CholeskyCovRegressor, torch_pbd.HeteroscedasticGPRegressor, torch_pbd.GMMBaseline"
_PROGRAMS = {
    "base": "import torch, sklearn",
    "package": "import torch, sklearn, torch_pbd",
    "names": f"import torch, sklearn, torch_pbd; {_NAMES}",
}
_HELP = "import sys; from torch_pbd.cli import main; main(['--help'])"


def measure(plan: Plan) -> Findings:
    """Fresh processes that take turns."""
    n_repetitions = plan.size(7, 1)
    programs = _PROGRAMS if not plan.quick else dict.fromkeys(_PROGRAMS, "import torch_pbd")
    times: dict[str, list[float]] = {name: [] for name in _PROGRAMS}
    for _ in range(n_repetitions):
        for name, program in programs.items():
            times[name].append(cpu_seconds(program))
    added = [package - base for package, base in zip(times["package"], times["base"], strict=True)]
    used = [names - base for names, base in zip(times["names"], times["base"], strict=True)]
    shown = [wall_seconds(_HELP) for _ in range(n_repetitions)]
    rows = [
        Row("import torch_pbd, over torch and scikit-learn", added, bar=("<=", 0.1)),
        Row("and its regressors used, over torch and scikit-learn", used, note="no bar: their modules load then"),
        Row("torch-pbd --help, wall", shown, bar=("<=", 0.5)),
    ]
    return Findings("imports", rows)
