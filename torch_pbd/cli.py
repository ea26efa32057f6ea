"""The command line: ``torch-pbd demo``, ``fit`` and so on; torch loads once there is work."""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any, TextIO

from torch_pbd.exceptions import ConfigError, FolderInUseError

_ERROR, _USAGE, _IN_USE, _INTERRUPTED, _TERMINATED = 1, 2, 3, 130, 143
_CHECKPOINT = "checkpoint"  # in the folder of results, while the work goes on


class _Terminated(BaseException):
    """SIGTERM, as KeyboardInterrupt is SIGINT."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns
    -------
    int
        Exit code: 0; 1, it failed; 2, it cannot be used; 3, another run writes the folder; 130 and 143, interrupted and
        terminated.
    """
    try:
        with _signals():
            return _answer(list(sys.argv[1:] if arguments is None else arguments))
    except ConfigError as error:
        return _complain(str(error), _USAGE)
    except FolderInUseError as error:
        return _complain(f"{error} Wait for it, or take another with --output FOLDER.", _IN_USE)
    except (ValueError, TypeError, OSError, MemoryError) as error:
        return _complain(str(error) or "the memory is not enough", _ERROR)
    except KeyboardInterrupt as stop:
        return _complain(f"interrupted{_remark(stop)}", _INTERRUPTED)
    except _Terminated as stop:
        return _complain(f"terminated{_remark(stop)}", _TERMINATED)


@contextmanager
def _signals() -> Iterator[None]:
    """SIGINT and SIGTERM are exceptions, the first time; the next one ends the process at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    errors = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: _Terminated}

    def handle(number: int, _: object) -> None:
        for each in errors:
            signal.signal(each, signal.SIG_DFL)
        raise errors[signal.Signals(number)]

    before = {number: signal.signal(number, handle) for number in errors}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _remark(stop: BaseException) -> str:
    return f"; {stop.args[0]}" if stop.args else ""


def _answer(arguments: Sequence[str]) -> int:
    import torch_pbd
    from torch_pbd.config import COMMANDS, nearest

    if not arguments or arguments[0] in ("-h", "--help"):
        _say(_help(COMMANDS))
        return 0
    if arguments[0] == "--version":
        _say(torch_pbd.__version__)
        return 0
    if arguments[0] not in COMMANDS:
        raise ConfigError(f"there is no command {arguments[0]!r}. {nearest(arguments[0], COMMANDS)}")
    return _run(arguments[0], arguments[1:])


def _run(command: str, arguments: Sequence[str]) -> int:
    from torch_pbd.config import chosen_groups, existing_file, parse

    options, config = parse(command, arguments)
    import matplotlib as mpl
    import torch

    mpl.use("Agg")
    torch.set_num_threads(1)  # the matrices are small: threads would only wait for each other
    if getattr(options, "data", None) is not None:
        options.data = existing_file(options.data)
    if command == "benchmark":
        options.groups = chosen_groups(options.groups)
    with _run_folder(options.output, command) as folder, warnings.catch_warnings():
        warnings.simplefilter("default")
        warnings.showwarning = _Notes()
        try:
            with _checkpoint(options, folder, command, config):
                folder.write_text("config.yaml", config)
                _say(_WORK[command](options, folder))
        except (KeyboardInterrupt, _Terminated) as stop:
            if (folder.path / _CHECKPOINT).exists():
                stop.args = (f"torch-pbd {command} --config {folder.path / 'config.yaml'} --resume goes on",)
            raise
    _say(f"\nresults: {folder.path}")
    return 0


def _run_folder(path: str, command: str) -> Any:
    from torch_pbd.experiments.run_folder import RunFolder

    try:
        return RunFolder(path, {"command": command})
    except OSError as error:
        reason = error.strerror or str(error)
        where = f" ({error.filename})" if error.filename else ""
        raise ConfigError(
            f"output: {path!r} cannot be a folder of results: {reason}{where}. Give another with --output FOLDER."
        ) from error


def _checkpoint(options: Any, folder: Any, command: str, config: str) -> Any:
    """What keeps the work's checkpoint, begun with the one that is there if asked to."""
    from torch_pbd.config import RESUMABLE
    from torch_pbd.experiments.resuming import checkpoint_of_run

    if command not in RESUMABLE:
        return nullcontext()
    return checkpoint_of_run(
        folder.path / _CHECKPOINT,
        config,
        options.data if hasattr(options, "data") else None,
        resume=options.resume,
        interval=options.checkpoint_interval,
    )


def _demo(options: Any, folder: Any) -> str:
    from torch_pbd import (
        CholeskyCovRegressor,
        GMMBaseline,
        HeteroscedasticGPRegressor,
        WishartProcessRegressor,
    )
    from torch_pbd.experiments.demo import run_demo

    models = {
        "HGP": HeteroscedasticGPRegressor(),
        "CD": CholeskyCovRegressor(),
        "WP": WishartProcessRegressor(),
        "GMM 5": GMMBaseline(n_components=5),
    }
    _say(f"{options.n_demos} made demonstrations of the tunnel task; the truth is that of 300 more\n")
    return run_demo(models, folder, n_demos=options.n_demos, seed=options.seed) + "\n\n" + _LEGEND


def _fit(options: Any, folder: Any) -> str:
    from torch_pbd.estimators._groups import fit_by_demonstration
    from torch_pbd.experiments.recordings import write_fitted

    demonstrations = _demonstrations(options)
    X, y, groups = demonstrations.stack(options.input)
    model = fit_by_demonstration(options.model, X, y, groups)
    name = type(model).__name__
    model_path, figure_path = write_fitted(model, demonstrations, folder, name, options.input)
    row = {
        "n_iter": model.n_iter_,
        "loss": model.loss_,
        "converged": model.converged_,
        "jitter": model.jitter_,
        "LL": model.score(X, y),
    }
    folder.write_metrics([{"model": name} | row])
    settled = "converged" if model.converged_ else "did not converge"
    return (
        f"{name} {settled} after {model.n_iter_} iterations; log-likelihood {row['LL']:.3f} nats per sample of the "
        f"data it was fitted to\nmodel:   {model_path}\nfigure:  {figure_path}"
    )


def _experiment(options: Any, folder: Any) -> str:
    from torch_pbd.data import load_demonstrations, make_tunnel_demonstrations
    from torch_pbd.experiments.recordings import describe
    from torch_pbd.experiments.robot import run_robot
    from torch_pbd.experiments.robot_figures import framework_figure

    if options.data is None:
        demonstrations = make_tunnel_demonstrations(
            options.n_demos, random_state=options.seed, common_start=options.common_start
        )
        _say(describe(demonstrations, "tunnel task"))
    else:
        demonstrations = load_demonstrations(options.data)
        _say(describe(demonstrations, options.data.name))
    where = f"along {demonstrations.names[0]}, at 20 % and 80 % of the movement; K is the stiffness there, N/m"
    _say(f"pushes of {options.push:g} N {where}\n")
    folder.write_figure(framework_figure(), "figure5_framework")
    made = options.data is None
    return run_robot(options.controllers, demonstrations, folder, peak=options.push, rate=options.rate, in_tunnel=made)


def _compare(options: Any, folder: Any) -> str:
    if options.data is not None:
        from torch_pbd.experiments.recordings import run_recordings

        demonstrations = _demonstrations(options)
        if len(demonstrations) < 2:
            raise ConfigError("data: there is one demonstration; to compare models, at least two are needed.")
        table = run_recordings(
            options.models,
            demonstrations,
            folder,
            input=options.input,
            max_folds=options.max_folds,
            n_jobs=options.n_jobs,
        )
        return f"{table}\n\n{_LEGEND}"
    from torch_pbd.experiments.simulation import run_simulation

    _say(f"eq. (14): {options.n_inputs} inputs x {options.n_draws} draws, medians over {options.n_seeds} seeds\n")
    return run_simulation(
        options.models,
        folder,
        readings=options.readings,
        n_seeds=options.n_seeds,
        n_inputs=options.n_inputs,
        n_demos=options.n_draws,
        max_folds=options.max_folds,
        n_jobs=options.n_jobs,
    )


def _benchmark(options: Any, folder: Any) -> str:
    from torch_pbd.experiments.benchmark import run_benchmark

    return run_benchmark(folder, options.groups, n_repetitions=options.n_repetitions, quick=options.quick)


_WORK = {"demo": _demo, "fit": _fit, "experiment": _experiment, "compare": _compare, "benchmark": _benchmark}


def _demonstrations(options: Any) -> Any:
    from torch_pbd.data import check_unimodal, load_demonstrations
    from torch_pbd.experiments.recordings import describe, prepare

    recorded = load_demonstrations(options.data)
    _say(describe(recorded, options.data.name))
    if len(recorded) == 1:
        warnings.warn(
            "There is one demonstration: what varies between demonstrations cannot be told from how one moves.",
            stacklevel=2,
        )
    check_unimodal(recorded)
    prepared = prepare(recorded, options.align, options.n_steps)
    if prepared is not recorded:
        _say(describe(prepared, f"after align={options.align}"))
    _say("")
    return prepared


class _Notes:
    """Shows each warning once, as one line on the standard error."""

    def __init__(self) -> None:
        self._shown: set[str] = set()

    def __call__(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        if str(message) not in self._shown:
            self._shown.add(str(message))
            _say(f"note ({category.__name__}): {message}", sys.stderr)


_LEGEND = """MSE: squared distance of Cholesky factors to the empirical covariances, units of the data (Table I)
error to truth: relative Frobenius error of the covariance; held-out LL: log-likelihood of left-out
demonstrations, nats per sample, its mean +- standard error and its median over the folds; 95 % holds: share of
left-out samples in the 95 % ellipse; least eig.: smallest eigenvalue of the predicted correlations"""


def _help(commands: Mapping[str, str]) -> str:
    width = max(map(len, commands))
    lines = [f"  {name:<{width}}  {text}" for name, text in commands.items()]
    return "\n".join(
        [
            "torch-pbd: learn how precise people are from demonstrations",
            "",
            "usage: torch-pbd COMMAND [--config FILE] [--option value ...]",
            "",
            *lines,
            "",
            "Options of a command: torch-pbd COMMAND --help. As YAML: torch-pbd COMMAND --print_config.",
        ]
    )


def _complain(message: str, code: int) -> int:
    _say(f"torch-pbd: {message}", sys.stderr)
    return code


def _say(text: str, stream: TextIO | None = None) -> None:
    """Print; once nobody reads, as behind ``| head``, the work goes on without a word."""
    stream = sys.stdout if stream is None else stream
    try:
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    sys.exit(main())
