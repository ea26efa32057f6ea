import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.regression import LinearEvidence
from torch_pbd.models.heteroscedastic.search import Search, SearchOptions
from torch_pbd.optim.batch import Status


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def evidence_of(family, inputs, response):
    def evidence(theta, rows):
        theta = theta.clone().requires_grad_()
        with torch.enable_grad():
            value = LinearEvidence.fit(5.0 * family.prepared(theta)(inputs), 5.0 * response[rows]).value
        return value.detach(), lambda: torch.autograd.grad(value, theta, torch.ones_like(value))[0]

    return evidence


def curves(inputs, rng):
    """A fast one and a slow one, with noise of a fifth."""
    x = inputs[:, 0].numpy()
    return tensor(np.stack([np.sin(12.0 * x), np.sin(2.0 * x)]) + 0.2 * rng.normal(size=(2, len(x))))


@pytest.fixture
def many_inputs():
    return torch.linspace(-0.5, 0.5, 40, dtype=torch.float64)[:, None]


def test_the_search_ends_where_that_of_scipy_does(many_inputs, rng):
    family = ProcessFamily(many_inputs, 0.3, 1.2, 0.0, exact=True)
    evidence = evidence_of(family, many_inputs, curves(many_inputs, rng))
    theta = Search(family, 2, SearchOptions(100, 1e-5)).run(evidence)
    for i in (0, 1):

        def loss(point, i=i):
            point = tensor(point)[None]
            return -float(evidence(point, torch.tensor([i]))[0] + family.log_prior(point)[0])

        ends = [minimize(loss, start, method="Nelder-Mead") for start in ([-2.0, 0.0], [-0.5, 0.0], [0.5, 1.0])]
        best = min(ends, key=lambda end: end.fun)
        assert loss(theta[i].tolist()) < best.fun + 1e-4
        np.testing.assert_allclose(theta[i], best.x, rtol=0, atol=1e-2)


def test_the_next_run_starts_where_the_last_ended(many_inputs, rng):
    """With the same evidence it is at the end with its first evaluation; with another it goes on from there."""
    family = ProcessFamily(many_inputs, 0.3, 1.2, 0.0, exact=True)
    response = curves(many_inputs, rng)
    search = Search(family, 2, SearchOptions(100, 1e-5))
    first = search.run(evidence_of(family, many_inputs, response))
    assert torch.equal(search.run(evidence_of(family, many_inputs, response)), first)
    assert search.options.ends[-1] == (0, Status.CONVERGED)
    other = evidence_of(family, many_inputs, response + 0.05 * torch.randn(2, 40).double())
    anew = Search(family, 2, SearchOptions(100, 1e-5)).run(other)
    torch.testing.assert_close(search.run(other), anew, rtol=0, atol=1e-3)


@pytest.mark.parametrize("n_restarts", [0, 2])
def test_evidence_that_cannot_be_computed_is_gone_around(n_restarts, many_inputs, rng):
    family = ProcessFamily(many_inputs, 0.3, 1.2, 0.0, exact=True)
    evidence = evidence_of(family, many_inputs, curves(many_inputs, rng))

    def limited(theta, rows):
        if (theta[:, -1] > 2.0).any():
            raise NotPositiveDefiniteError("too large")
        return evidence(theta, rows)

    expected = Search(family, 2, SearchOptions(100, 1e-5)).run(evidence)
    found = Search(family, 2, SearchOptions(100, 1e-5, n_restarts)).run(limited)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3)


def test_a_process_whose_evidence_cannot_be_computed_leaves_the_others_alone(many_inputs, rng):
    family = ProcessFamily(many_inputs, 0.3, 1.2, 0.0, exact=True)
    evidence = evidence_of(family, many_inputs, curves(many_inputs, rng))

    def failing(theta, rows):
        if ((rows == 0) & (theta[:, -1] > -0.5)).any():
            raise NotPositiveDefiniteError("too large")
        return evidence(theta, rows)

    searches = [Search(family, 2, SearchOptions(100, 1e-5)) for _ in range(2)]
    (points, of_one), (_, expected) = searches[0].on_grid(failing), searches[1].on_grid(evidence)
    assert of_one[:, 0].isneginf().tolist() == (points[:, -1] > -0.5).tolist()
    torch.testing.assert_close(of_one[:, 1], expected[:, 1], rtol=1e-12, atol=0)
    torch.testing.assert_close(searches[0].run(failing)[1], searches[1].run(evidence)[1], rtol=0, atol=1e-6)
