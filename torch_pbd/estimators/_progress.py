"""What a fit says while it goes on."""

import sys
from collections.abc import Callable
from contextlib import suppress

from torch_pbd.optim import Progress


def printed_progress(name: str, verbose: int) -> Callable[[Progress], None]:
    """Callback that prints the loss to the error output, more often for higher ``verbose``."""

    def show(progress: Progress) -> None:
        if progress.n_evaluations < 5 or progress.n_evaluations % max(1, 10 // verbose) in (0, 1):
            with suppress(BrokenPipeError):  # nobody reads it
                print(
                    f"{name}: evaluation {progress.n_evaluations:5d}  loss {progress.loss:14.6f}  "
                    f"{progress.elapsed:7.2f} s",
                    file=sys.stderr,
                )

    return show
