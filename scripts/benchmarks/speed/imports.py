"""What importing the package and asking the command line for help take."""

from speed.fresh import added_seconds, wall_seconds
from speed.rows import Findings, Plan, Row

_NAMES = "torch_pbd.CholeskyCovRegressor, torch_pbd.HeteroscedasticGPRegressor, torch_pbd.GMMBaseline"
_HELP = "import sys; from torch_pbd.cli.main import main; main(['--help'])"


def measure(plan: Plan) -> Findings:
    """In fresh processes, each anew."""
    n_repetitions = plan.size(7, 1)
    base = "import sys" if plan.quick else "import torch, sklearn"
    added = [added_seconds(base, "import torch_pbd") for _ in range(n_repetitions)]
    shown = [wall_seconds(_HELP) for _ in range(n_repetitions)]
    rows = [
        Row("import torch_pbd, after torch and scikit-learn", added, bar=("<=", 0.1)),
        Row("torch-pbd --help, wall", shown, bar=("<=", 0.5)),
    ]
    if not plan.quick:
        used = [added_seconds(base, f"import torch_pbd; {_NAMES}") for _ in range(n_repetitions)]
        rows.append(Row("and its regressors", used, note="no bar: the modules of the regressors load with them"))
    return Findings("imports", rows)
