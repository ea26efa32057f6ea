import math

import pytest
import torch
from scipy.optimize import rosen

from torch_pbd.optim import minimize, minimize_batch, minimize_batch_with_gradient


def parameter(*values):
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


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
    assert not report.converged
    assert "max_iter=7" in report.message
    assert list(report.loss_curve) == sorted(report.loss_curve, reverse=True)
    assert report.loss == report.loss_curve[-1] == rosenbrock(x).item()


@pytest.mark.parametrize("fault", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_leaves_the_best_point(fault):
    x, calls = parameter(-1.2, 1.0), []

    def objective():
        calls.append(1)
        return rosenbrock(x) * (fault if len(calls) >= 7 else 1.0)

    report = minimize(objective, [x])
    assert not report.converged
    assert "not finite" in report.message
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

    found, report = minimize_batch(objective, start, max_iter=300, tol=1e-9)
    assert report.converged
    torch.testing.assert_close(found, target, rtol=1e-6, atol=1e-6)


def test_the_problems_of_a_batch_do_not_disturb_each_other(generator):
    start = torch.randn(5, 3, dtype=torch.float64, generator=generator)
    together, _ = minimize_batch(lambda x, _: rosenbrock(x), start, max_iter=40)
    alone = [minimize_batch(lambda x, _: rosenbrock(x), row[None], max_iter=40)[0] for row in start]
    torch.testing.assert_close(together, torch.cat(alone), rtol=1e-6, atol=1e-6)


def test_a_batch_steps_back_from_values_that_are_not_finite():
    start = torch.tensor([[1e-3], [50.0]], dtype=torch.float64)
    found, _ = minimize_batch(lambda x, _: (x - x.log()).squeeze(-1), start, tol=1e-9)
    torch.testing.assert_close(found, torch.ones(2, 1, dtype=torch.float64), rtol=1e-6, atol=0)


def test_a_batch_ends_where_steps_no_longer_lower_the_rounded_loss():
    start = torch.ones(3, 2, dtype=torch.float64)
    _, report = minimize_batch(lambda x, _: 1e8 + 1e-9 * x.sum(-1), start, max_iter=1000, tol=1e-12)
    assert report.n_iter < 50


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
    given, report = minimize_batch_with_gradient(objective, start, tol=1e-9)
    by_autograd, other = minimize_batch(lambda x, rows: objective(x, rows)[0], start, tol=1e-9)
    torch.testing.assert_close(given, by_autograd, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(given, minimum, rtol=1e-6, atol=1e-6)
    assert report.n_iter == other.n_iter
    assert torch.equal(start, torch.zeros_like(start))


def test_the_inverse_hessian_maps_the_last_change_of_the_gradient_to_the_last_step(generator):
    """The secant equation, by which BFGS is defined; and it stays symmetric and positive definite."""
    _, _, objective = quadratics(generator)
    start = torch.zeros(5, 3, dtype=torch.float64)
    before, after = (minimize_batch_with_gradient(objective, start, tol=1e-12, max_iter=k) for k in (3, 4))
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
    found, report = minimize_batch_with_gradient(objective, near, tol=1e-9, inverse_hessian=inverse)
    assert report.n_iter == 1
    torch.testing.assert_close(found, minimum, rtol=1e-9, atol=1e-9)
    close = minimum + 1e-5
    found, report = minimize_batch_with_gradient(objective, close, tol=1e-6, inverse_hessian=inverse)
    assert (report.n_iter, report.converged) == (0, True)
    assert torch.equal(found, close)
