import math
from importlib import import_module

import pytest
import torch
from scipy.optimize import rosen

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.optim.batch import FitReport, Status, first_failure, minimize_batch
from torch_pbd.optim.descent import minimize, minimize_scoring


def parameter(*values):
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


def by_autograd(objective):
    """Values and gradients of losses (a,) of unrelated problems."""

    def value_and_gradient(x, rows):
        leaf = x.detach().requires_grad_()
        loss = objective(leaf, rows)
        (gradient,) = torch.autograd.grad(loss.sum(), leaf)
        return loss.detach(), gradient

    return value_and_gradient


def rosenbrock(x):
    return (100 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1 - x[..., :-1]) ** 2).sum(-1)


def test_minimize_finds_the_minimum_of_rosenbrock():
    x = parameter(-1.2, 1.0, 1.0)
    report = minimize(lambda: rosenbrock(x), [x], tol=1e-10)
    assert report.converged
    torch.testing.assert_close(x.detach(), torch.ones(3, dtype=torch.float64), rtol=1e-6, atol=0)
    assert report.loss == pytest.approx(rosen(x.detach().numpy()), abs=1e-15)


def test_the_curve_falls_and_ends_at_the_loss_of_the_parameters():
    x = parameter(-1.2, 1.0)
    report = minimize(lambda: rosenbrock(x), [x], max_iter=7)
    assert report.status is Status.MAX_ITER
    assert list(report.loss_curve) == sorted(report.loss_curve, reverse=True)
    assert report.loss == report.loss_curve[-1] == rosenbrock(x).item()


@pytest.mark.parametrize("fault", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_leaves_the_best_point(fault):
    x, calls = parameter(-1.2, 1.0), []

    def objective():
        calls.append(1)
        return rosenbrock(x) * (fault if len(calls) >= 7 else 1.0)

    report = minimize(objective, [x])
    assert report.status is Status.NOT_FINITE
    assert report.loss == rosenbrock(x).item() <= report.loss_curve[0]
    assert len(calls) == 10  # one failure, three restarts that fail at once


def test_a_fault_that_passes_is_survived():
    x, calls = parameter(-1.2, 1.0), []

    def objective():
        calls.append(1)
        return rosenbrock(x) * (math.nan if len(calls) == 7 else 1.0)

    report = minimize(objective, [x], tol=1e-10)
    assert report.converged
    assert report.loss < 1e-10


def test_a_search_of_torch_that_raises_is_a_failed_line_search(monkeypatch):
    """Its strong Wolfe search has an IndexError where it brackets no minimum."""
    monkeypatch.setattr(import_module("torch.optim.lbfgs"), "_strong_wolfe", lambda *_, **__: [][0])
    x = parameter(-1.2, 1.0)
    report = minimize(lambda: rosenbrock(x), [x])
    assert report.status is Status.LINE_SEARCH_FAILED
    assert "IndexError" in report.message
    assert (report.loss, report.n_iter) == (rosenbrock(x).item(), 4)


def test_a_loss_that_disagrees_with_itself_ends_at_the_most_evaluations():
    x, calls = parameter(-1.2, 1.0), []

    def objective():
        calls.append(1)
        return rosenbrock(x) + 10.0 * (len(calls) % 2)

    report = minimize(objective, [x], tol=1e-10, max_iter=100)
    assert report.status is Status.MAX_ITER
    assert 3 * 220 / 2 < len(calls) <= 4 * 220 + 4 * 25  # a line search may go beyond


@pytest.mark.parametrize("status", Status)
def test_a_report_after_another_that_failed_has_failed_too(status):
    first, good = FitReport(2.0, (2.0,), 3, status, "why"), FitReport(1.0, (1.0,), 1, Status.CONVERGED)
    after = good.after(first, "the first")
    assert (after.status, after.loss, after.n_iter) == (status, 1.0, 1)
    assert after.message == ("converged" if status is Status.CONVERGED else "the first: why")
    assert first.after(good, "") is first
    assert after.converged == (status is Status.CONVERGED)
    expected = Status.NOT_FINITE if status is Status.CONVERGED else status
    assert first_failure([Status.CONVERGED, status, Status.NOT_FINITE]) is expected
    assert first_failure([]) is Status.CONVERGED


def test_a_barrier_never_ends_worse_than_it_started():
    x = parameter(1e-3)
    report = minimize(lambda: (x**2 - 1e-8 * torch.log(x - 1e-9)).sum(), [x])
    assert report.loss <= report.loss_curve[0]
    assert x.item() > 1e-9


def test_a_start_that_is_not_finite_is_an_error():
    x = parameter(-1.0)
    with pytest.raises(ValueError, match="cannot start"):
        minimize(lambda: x.log().sum(), [x])


def test_a_batch_finds_what_each_problem_alone_finds(generator):
    start = torch.randn(6, 2, dtype=torch.float64, generator=generator)
    target = torch.randn(6, 2, dtype=torch.float64, generator=generator)

    def objective(x, rows):
        return rosenbrock(x - target[rows] + 1.0)

    found, report = minimize_batch(by_autograd(objective), start, max_iter=300, tol=1e-11)
    assert report.status is Status.CONVERGED
    torch.testing.assert_close(found, target, rtol=1e-6, atol=1e-6)


def test_the_problems_of_a_batch_do_not_disturb_each_other(generator):
    start = torch.randn(5, 3, dtype=torch.float64, generator=generator)
    together, _ = minimize_batch(by_autograd(lambda x, _: rosenbrock(x)), start, max_iter=40)
    alone = [minimize_batch(by_autograd(lambda x, _: rosenbrock(x)), row[None], max_iter=40)[0] for row in start]
    torch.testing.assert_close(together, torch.cat(alone), rtol=1e-6, atol=1e-6)


def test_a_batch_steps_back_from_values_that_are_not_finite():
    start = torch.tensor([[1e-3], [50.0]], dtype=torch.float64)
    found, _ = minimize_batch(by_autograd(lambda x, _: (x - x.log()).squeeze(-1)), start, tol=1e-9)
    torch.testing.assert_close(found, torch.ones(2, 1, dtype=torch.float64), rtol=1e-6, atol=0)


def test_a_batch_ends_where_steps_no_longer_lower_the_rounded_loss():
    start = torch.ones(3, 2, dtype=torch.float64)
    _, report = minimize_batch(by_autograd(lambda x, _: 1e8 + 1e-9 * x.sum(-1)), start, max_iter=1000, tol=1e-12)
    assert report.n_iter < 50


def gauss_newton(residual):
    """Half the square of a residual, and its Newton step with Gauss's matrix."""

    def newton(x):
        jacobian, value = torch.autograd.functional.jacobian(residual, x), residual(x)
        gradient = jacobian.mT @ value
        return gradient, -torch.linalg.solve(jacobian.mT @ jacobian, gradient)

    return lambda x: 0.5 * residual(x).square().sum(), newton


def test_scoring_takes_one_step_to_the_minimum_of_a_parabola(generator):
    matrix, target = torch.randn(4, 4, dtype=torch.float64, generator=generator), torch.ones(4, dtype=torch.float64)
    loss, newton = gauss_newton(lambda x: matrix @ (x - target))
    x, report = minimize_scoring(loss, newton, torch.zeros(4, dtype=torch.float64))
    torch.testing.assert_close(x, target, rtol=1e-9, atol=0)
    assert report.converged
    assert report.n_iter == 2  # the second finds nothing to gain
    assert report.loss_curve[0] == 0.5 * (matrix @ target).square().sum().item()


def test_scoring_finds_the_minimum_of_rosenbrock():
    loss, newton = gauss_newton(lambda x: torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]]))
    seen = []
    start = torch.tensor([-1.2, 1.0], dtype=torch.float64)
    x, report = minimize_scoring(loss, newton, start, callback=lambda progress: seen.append(progress.loss))
    torch.testing.assert_close(x, torch.ones(2, dtype=torch.float64), rtol=1e-6, atol=0)
    assert report.converged
    assert list(report.loss_curve) == sorted(report.loss_curve, reverse=True) == seen
    assert report.loss == report.loss_curve[-1] == 0.5 * rosenbrock(x).item()


def test_scoring_steps_back_from_values_that_are_not_finite():
    """Steps of 30 times the gradient leave the domain of x - log x."""
    start = torch.tensor([0.5], dtype=torch.float64)
    x, report = minimize_scoring(
        lambda x: (x - x.log()).sum(), lambda x: (1 - 1 / x, -30 * (1 - 1 / x) * x), start, tol=1e-12, max_iter=500
    )
    assert report.converged
    torch.testing.assert_close(x, torch.ones(1, dtype=torch.float64), rtol=1e-6, atol=0)


def test_scoring_lengthens_steps_where_the_loss_is_a_line():
    """To where |x| bends it is 1000 of the steps given, of which 100 are allowed."""
    start = torch.tensor([1000.0], dtype=torch.float64)
    x, report = minimize_scoring(lambda x: (1 + x**2).sqrt().sum(), lambda x: (x / (1 + x**2).sqrt(), -x.sign()), start)
    assert abs(x.item()) < 1.0
    assert report.n_iter < 50


def test_scoring_stays_where_no_step_lowers_the_loss():
    start = torch.tensor([1.0], dtype=torch.float64)
    x, report = minimize_scoring(lambda x: x.sum(), lambda x: (-torch.ones(1).double(), torch.ones(1).double()), start)
    assert x is start
    assert report.status is Status.LINE_SEARCH_FAILED
    assert report.loss == 1.0


def test_scoring_needs_a_finite_start():
    start = torch.tensor([-1.0], dtype=torch.float64)
    with pytest.raises(ValueError, match="cannot start"):
        minimize_scoring(lambda x: x.log().sum(), lambda x: (1 / x, -x), start)


def test_scoring_tells_that_it_stopped_early():
    loss, newton = gauss_newton(lambda x: torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]]))
    _, report = minimize_scoring(loss, newton, torch.tensor([-1.2, 1.0], dtype=torch.float64), max_iter=1)
    assert report.status is Status.MAX_ITER


def quadratics(generator):
    """Five problems with their Hessians and minima, and what returns losses and gradients."""
    root = torch.randn(5, 3, 3, dtype=torch.float64, generator=generator)
    hessian = root @ root.mT + 0.1 * torch.eye(3, dtype=torch.float64)
    minimum = torch.randn(5, 3, dtype=torch.float64, generator=generator)

    def objective(x, rows):
        pulled = (hessian[rows] @ (x - minimum[rows]).unsqueeze(-1)).squeeze(-1)
        return 0.5 * ((x - minimum[rows]) * pulled).sum(-1), pulled

    return hessian, minimum, objective


def test_a_batch_with_gradients_goes_the_way_of_autograd(generator):
    _, minimum, objective = quadratics(generator)
    start = torch.zeros(5, 3, dtype=torch.float64)
    given, report = minimize_batch(objective, start, tol=1e-9)
    found, other = minimize_batch(by_autograd(lambda x, rows: objective(x, rows)[0]), start, tol=1e-9)
    torch.testing.assert_close(given, found, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(given, minimum, rtol=1e-6, atol=1e-6)
    assert report.n_iter == other.n_iter
    assert torch.equal(start, torch.zeros_like(start))


def test_the_inverse_hessian_maps_the_last_change_of_the_gradient_to_the_last_step(generator):
    """The secant equation, by which BFGS is defined; and it stays symmetric and positive definite."""
    _, _, objective = quadratics(generator)
    start = torch.zeros(5, 3, dtype=torch.float64)
    rough = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    before, after = (minimize_batch(objective, start, tol=1e-12, max_iter=k, inverse_hessian=rough) for k in (3, 4))
    assert (before[0] - after[0]).abs().amax(1).min() > 1e-9
    every = torch.arange(5)
    change = objective(after[0], every)[1] - objective(before[0], every)[1]
    inverse = after[1].inverse_hessian
    step = (inverse @ change.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(step, after[0] - before[0], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(inverse, inverse.mT, rtol=1e-9, atol=1e-12)
    assert (torch.linalg.eigvalsh(inverse) > 0).all()


def test_with_its_inverse_hessian_a_quadratic_takes_newtons_step_and_at_the_end_none(generator):
    hessian, minimum, objective = quadratics(generator)
    inverse = torch.linalg.inv(hessian)
    near = minimum + 0.3  # the first step is at most of length one
    found, report = minimize_batch(objective, near, tol=1e-9, inverse_hessian=inverse)
    assert report.n_iter == 1
    torch.testing.assert_close(found, minimum, rtol=1e-9, atol=1e-9)
    close = minimum + 1e-5
    found, report = minimize_batch(objective, close, tol=1e-6, inverse_hessian=inverse)
    assert (report.n_iter, report.status) == (0, Status.CONVERGED)
    assert torch.equal(found, close)


def test_a_batch_may_be_empty(generator):
    _, _, objective = quadratics(generator)
    found, report = minimize_batch(objective, torch.zeros(0, 3, dtype=torch.float64))
    assert found.shape == (0, 3)
    assert (report.n_iter, report.status) == (0, Status.CONVERGED)


RAISED = [
    RuntimeError("a"),
    torch.linalg.LinAlgError("b"),
    NotPositiveDefiniteError("c"),
    IndexError("d"),
    ZeroDivisionError("e"),
]


@pytest.mark.parametrize("fault", [*RAISED, math.nan, -math.inf], ids=repr)
@pytest.mark.parametrize("when", [2, 7, 8, 30])
def test_whatever_an_evaluation_raises_the_best_point_is_left_and_the_reason_told(fault, when):
    """At every call from then on; -inf is what a likelihood without a floor falls to."""
    x, calls = parameter(-1.2, 1.0), []

    def objective():
        calls.append(1)
        if len(calls) < when:
            return rosenbrock(x)
        if isinstance(fault, Exception):
            raise fault
        return rosenbrock(x) * 0.0 + fault

    start = rosenbrock(x).item()
    report = minimize(objective, [x])
    assert report.status is Status.NOT_FINITE
    assert (str(fault) if isinstance(fault, Exception) else "not finite") in report.message
    assert report.loss == rosenbrock(x).item() == min(report.loss_curve) <= start
    assert len(calls) <= when + 3
    assert x.grad is None


@pytest.mark.parametrize("fault", [TypeError("a mistake"), KeyboardInterrupt(), MemoryError()], ids=repr)
def test_mistakes_and_interrupts_are_passed_on_and_the_best_point_is_left(fault):
    x, seen = parameter(-1.2, 1.0), []

    def objective():
        if len(seen) == 9:
            raise fault
        seen.append((rosenbrock(x).item(), x.detach().clone()))
        return rosenbrock(x)

    with pytest.raises(type(fault)):
        minimize(objective, [x])
    assert torch.equal(x.detach(), min(seen, key=lambda pair: pair[0])[1])


def test_a_wall_beside_the_minimum_never_ends_worse_than_the_start():
    for wall in torch.linspace(0.05, 3.0, 60).double():
        x = parameter(4.0)

        def objective(x=x, wall=wall):
            return (x.square() + 1e12 * (x < wall) * (wall - x)).sum()

        report = minimize(objective, [x], tol=1e-10)
        assert report.loss == objective().item() <= 16.0


@pytest.mark.parametrize("fault", RAISED, ids=repr)
def test_a_batch_loses_only_the_problem_that_raises(fault):
    """One of three cannot be evaluated beyond a wall, one nowhere; the third does not notice."""

    def objective(x, rows):
        if bool(((rows == 0) & (x[:, 0] > 0.5)).any()) or bool((rows == 1).any()):
            raise fault
        return (x - torch.tensor([[1.0], [1.0], [1.0]]).double()[rows]).square().sum(-1)

    start = torch.zeros(3, 1, dtype=torch.float64)
    x, report = minimize_batch(by_autograd(objective), start)
    assert 0.0 < x[0, 0] <= 0.5
    assert x[1, 0] == 0.0
    assert math.isnan(report.loss[1])
    assert report.status is Status.NOT_FINITE
    assert x[2, 0].item() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("fault", [*RAISED, math.nan, -math.inf], ids=repr)
def test_scoring_takes_what_raises_for_too_far_and_keeps_its_best_point(fault):
    wall = 0.9

    def loss(x):
        if bool((x < wall).any()):
            if isinstance(fault, Exception):
                raise fault
            return torch.tensor(fault)
        return x.square().sum()

    x, report = minimize_scoring(loss, lambda x: (2 * x, -x), torch.tensor([3.0, 2.0], dtype=torch.float64))
    assert report.loss == x.square().sum().item() < 13.0
    assert bool((x >= wall).all())


@pytest.mark.parametrize("fault", RAISED, ids=repr)
def test_scoring_ends_where_there_is_no_step_to_take(fault):
    calls = []

    def newton(x):
        calls.append(1)
        if len(calls) == 3:
            raise fault
        return 2 * x, -0.5 * x

    x, report = minimize_scoring(lambda x: x.square().sum(), newton, torch.tensor([2.0], dtype=torch.float64))
    assert report.status is Status.NOT_FINITE
    assert report.message == str(fault)
    assert report.loss == x.square().sum().item() < 4.0
    with pytest.raises(ValueError, match="cannot start"):
        minimize_scoring(lambda x: x.square().sum(), lambda _: [][calls[0]], torch.tensor([2.0], dtype=torch.float64))
