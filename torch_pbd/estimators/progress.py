"""What a fit says while it goes on."""

import sys
from collections.abc import Callable

from torch_pbd.console import say
from torch_pbd.optim import Progress


def printed_progress(name: str, verbose: int) -> Callable[[Progress], None]:
    """Callback that prints the loss to the error output, more often for higher ``verbose``."""

    def show(progress: Progress) -> None:
        if progress.n_evaluations < 5 or progress.n_evaluations % max(1, 10 // verbose) in (0, 1):
            count, loss, elapsed = progress.n_evaluations, progress.loss, progress.elapsed
            say(f"{name}: evaluation {count:5d}  loss {loss:14.6f}  {elapsed:7.2f} s", sys.stderr)

    return show
