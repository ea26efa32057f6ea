"""Work that is cut anywhere and begun again with its journal ends where the whole of it does, to the bit."""

import math

import numpy as np
import pytest
import torch
from estimators.zoo import VARIANTS, demonstrations, fit, new, predictions, queries
from scipy.optimize import rosen, rosen_der, rosen_hess

from torch_pbd.checkpoint import checkpointed, read_checkpoint, write_checkpoint
from torch_pbd.exceptions import ModelFileError
from torch_pbd.optim import Journal, by_autograd, minimize, minimize_batch, minimize_scoring, recorded

START = [-1.2, 1.0, 0.5]


class Cut(BaseException):
    """Like an interrupt: nothing on the way may catch it."""


class CutJournal(Journal):
    """Raises once so many states are kept."""

    def __init__(self, n_states=math.inf):
        super().__init__()
        self.n_left = n_states

    def keep(self, index, state, *, ended):
        super().keep(index, state, ended=ended)
        self.n_left -= 1
        if self.n_left == 0:
            raise Cut


def cut_and_resumed(work, n_states, path):
    """What some work gives when it is cut after so many states, written, read, and gone on with; None if it was not."""
    journal = CutJournal(n_states)
    with recorded(journal):
        try:
            work()
        except Cut:
            pass
        else:
            return None
    write_checkpoint(path, {}, journal.entries)
    counted = CutJournal()
    counted.entries = read_checkpoint(path)[1]
    with recorded(counted):
        return work()


def rosenbrock(x):
    return (100 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1 - x[..., :-1]) ** 2).sum(-1)


def by_lbfgs():
    x, calls = torch.tensor(START, dtype=torch.float64, requires_grad=True), []

    def objective():
        calls.append(1)
        return rosenbrock(x)

    report = minimize(objective, [x], tol=1e-12, history_size=4)
    return x.detach(), report, len(calls)


def by_lbfgs_with_a_fault():
    """Not finite beyond a wall, at which the first attempts fail."""
    x, calls = torch.tensor(START, dtype=torch.float64, requires_grad=True), []

    def objective():
        calls.append(1)
        return rosenbrock(x) / (x[1] < 1.3)

    report = minimize(objective, [x], tol=1e-12)
    return x.detach(), report, len(calls)


def by_scoring():
    carried, calls = torch.zeros(1), []

    def newton(x):
        calls.append(1)
        carried.add_(1)
        hessian = torch.tensor(rosen_hess(x.numpy()))
        hessian += (1.0 / carried.double()) * torch.eye(3).double()  # another step for each call before
        gradient = torch.tensor(rosen_der(x.numpy()))
        return gradient, -torch.linalg.solve(hessian, gradient)

    start = torch.tensor(START, dtype=torch.float64)
    x, report = minimize_scoring(lambda x: torch.tensor(rosen(x.numpy())), newton, start, carried=[carried], tol=1e-12)
    return x, report, len(calls)


def in_a_batch():
    calls = []

    def objective(x, rows):
        calls.append(1)
        return rosenbrock(x) * (1.0 + rows)

    start = torch.tensor([START, [0.3, 0.2, -1.0]], dtype=torch.float64)
    x, report = minimize_batch(by_autograd(objective), start)
    return x, (report.loss.tolist(), report.inverse_hessian.tolist(), report.n_iter, report.converged), len(calls)


@pytest.mark.parametrize("work", [by_lbfgs, by_lbfgs_with_a_fault, by_scoring, in_a_batch])
def test_an_optimization_goes_on_where_it_was_cut(work, tmp_path):
    x, report, n_calls = work()
    for n_states in range(1, 1000):
        resumed = cut_and_resumed(work, n_states, tmp_path / "checkpoint")
        if resumed is None:
            break
        assert torch.equal(resumed[0], x)
        assert resumed[1] == report
        assert resumed[2] < n_calls  # and not from the beginning
    assert n_states >= (2 if work is in_a_batch else 4)


def test_optimizations_that_ended_are_not_run_again(tmp_path):
    """The one that was cut goes on; those before it are not even evaluated."""

    def work():
        return [by_lbfgs(), in_a_batch(), by_scoring()]

    whole = work()
    journal = Journal()
    with recorded(journal):
        work()
    assert [entry.ended for entry in journal.entries] == [True, True, True]
    with recorded(Journal(journal.entries[:2])):
        again = work()
    assert [n_calls for *_, n_calls in again] == [0, 0, whole[2][2]]
    for (x, report, _), (x_again, report_again, _) in zip(whole, again, strict=True):
        assert torch.equal(x, x_again)
        assert report == report_again


def test_what_starts_elsewhere_is_run_from_its_start():
    """An entry of another start is dropped, and those behind it, which rest on its end."""
    journal = Journal()
    with recorded(journal):
        minimize_scoring(lambda x: x.square().sum(), lambda x: (2 * x, -x), torch.tensor([3.0]).double())
        by_lbfgs()
    again = Journal(journal.entries)
    with recorded(again):
        x, _ = minimize_scoring(lambda x: (x - 1).square().sum(), lambda x: (2 * x - 2, 1 - x), torch.zeros(1).double())
        assert x.item() == 1.0
        assert len(again.entries) == 1


def test_without_a_journal_nothing_is_kept_and_inside_none_neither():
    journal = Journal()
    with recorded(journal), recorded(None):
        by_lbfgs()
    by_lbfgs()
    assert journal.entries == []


@pytest.mark.parametrize("name", VARIANTS)
def test_a_fit_goes_on_where_it_was_cut(name, tmp_path):
    X, y = demonstrations(n_demos=6)
    x = queries(1)
    options = {"groups": np.arange(len(X)) // 8} if name == "heteroscedastic" else {}

    def work():
        model = fit(new(name), X, y) if not options else new(name).fit(X, y, **options)
        return *predictions(model, x), model.loss_, model.loss_curve_, model.n_iter_, model.jitter_

    whole, n_states = work(), 0
    for step in (1, 2, 5, 25):
        n_states += step
        resumed = cut_and_resumed(work, n_states, tmp_path / "checkpoint")
        if resumed is None:
            break
        for mine, others in zip(whole, resumed, strict=True):
            np.testing.assert_array_equal(mine, others)
    assert n_states > 1 or name in ("cholesky", "cholesky-log")  # those search once


def test_a_checkpoint_is_there_until_the_work_is_done(tmp_path):
    path, seen = tmp_path / "checkpoint", []

    def watched(x):
        seen.append(len(read_checkpoint(path)[1]))
        return x.square().sum()

    def cut():
        minimize_scoring(watched, lambda x: (2 * x, -0.5 * x), torch.ones(2).double())
        raise Cut

    with pytest.raises(Cut), checkpointed(path, {"what": "a test"}, interval=0.0):
        cut()
    assert seen[0] == 0  # from the beginning
    assert seen[-1] == 1
    work, entries = read_checkpoint(path)
    assert work == {"what": "a test"}
    with checkpointed(path, work, entries=entries):
        minimize_scoring(watched, lambda x: (2 * x, -0.5 * x), torch.ones(2).double())
    assert not path.exists()


def test_a_checkpoint_that_cannot_be_written_is_told_and_the_work_goes_on(tmp_path):
    path = tmp_path / "checkpoint"
    path.mkdir()
    told = pytest.warns(UserWarning, match=r"No checkpoint could be written .*Is a directory")
    with told, checkpointed(path, {}, interval=1e9):
        x, _, _ = by_lbfgs()
    torch.testing.assert_close(x, torch.ones(3).double())


def test_a_checkpoint_that_is_damaged_is_an_error(tmp_path):
    path = tmp_path / "checkpoint"
    journal = Journal()
    with recorded(journal):
        by_lbfgs()
    write_checkpoint(path, {}, journal.entries)
    whole = path.read_bytes()
    for broken in (
        whole[:-1],
        whole[: len(whole) // 2],
        b"",
        whole[:-8] + b"\0" * 8,
        whole.replace(b"L-BFGS", b"L-BFGT"),
    ):
        path.write_bytes(broken)
        with pytest.raises(ModelFileError, match="checkpoint"):
            read_checkpoint(path)
