import numpy as np
import pytest
import torch
from scipy.optimize import minimize as scipy_minimize

from torch_pbd.linalg import scale_tril_from_root
from torch_pbd.models import with_floor
from torch_pbd.models.costs import LatentValues, Likelihood, train
from torch_pbd.models.links import CholeskyLink, WishartLink, padded
from torch_pbd.models.training import TrainingSet

COUNTS = {"aligned": [30] * 8, "ragged": [5, 12, 30, 10, 6, 50, 8], "not aligned": [1] * 60}
LINKS = ["cholesky", "cholesky-log", "wishart"]


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def random_tril(d, rng):
    return tensor(np.linalg.cholesky(np.atleast_2d(np.cov(rng.normal(size=(d, 3 * d + 2))))))


def gaussian_nll(root, scatter_root, counts):
    """Differentiable by autograd; its value is that of scipy in test_objectives."""
    return Likelihood(CholeskyLink(torch.eye(root.shape[1]).to(root), False), scatter_root, counts, 1.0).at_root(root)


def make_link(kind, d, rng, n_inputs=None):
    """Link whose prior is one factor, or another at each input."""
    prior = random_tril(d, rng) if n_inputs is None else torch.stack([random_tril(d, rng) for _ in range(n_inputs)])
    return WishartLink(padded(prior, d + 1)) if kind == "wishart" else CholeskyLink(prior, kind == "cholesky-log")


def n_processes(link):
    d = _size(link)
    return d * (d + 1) if isinstance(link, WishartLink) else d * (d + 1) // 2


def _size(link):
    return link.prior.shape[-2]


def deviations(link, n_inputs, rng):
    return tensor(0.3 * rng.normal(size=(n_inputs, n_processes(link))))


def scatters(link, n_inputs, rng):
    d = _size(link)
    return tensor(rng.normal(size=(n_inputs, d, d))), tensor(rng.integers(1, 9, size=n_inputs).astype(float))


def block_diagonal(blocks, n_inputs, size):
    """Second derivatives at all inputs as one matrix over the flattened deviations (n, b)."""
    whole = torch.zeros(n_inputs, size, n_inputs, size, dtype=torch.float64)
    for members, block in blocks:
        for i in range(n_inputs):
            whole[i, members[:, None], i, members] = block[i]
    return whole.reshape(n_inputs * size, -1)


def gradients(cost, deviation):
    """In closed form, and by autograd."""
    (expected,) = torch.autograd.grad(cost(deviation), deviation)
    with torch.no_grad():
        return cost.gradient(cost.covariances(deviation)), expected


@pytest.mark.parametrize("own_priors", [False, True])
@pytest.mark.parametrize("kind", LINKS)
@pytest.mark.parametrize("d", [1, 2, 9])
def test_the_gradient_of_the_likelihood_is_that_of_autograd(kind, d, own_priors, rng):
    link = make_link(kind, d, rng, 4 if own_priors else None)
    deviation = deviations(link, 4, rng).requires_grad_()
    scatter_root, counts = scatters(link, 4, rng)
    cost = Likelihood(link, scatter_root, counts, 0.1)
    assert cost(deviation).item() == pytest.approx(
        0.1 * gaussian_nll(link.root(deviation), scatter_root, counts).item(), rel=1e-12
    )
    torch.testing.assert_close(*gradients(cost, deviation), rtol=1e-8, atol=1e-9)


def test_the_gradient_is_right_where_the_floor_is_what_is_left(rng):
    link = CholeskyLink(torch.eye(2).double(), True)
    deviation = tensor([[-14.0, 0.3, -13.0], [-20.0, 0.0, 1.0]]).requires_grad_()
    cost = Likelihood(link, torch.zeros(2, 2, 1).double(), torch.ones(2).double(), 1.0)
    torch.testing.assert_close(*gradients(cost, deviation), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("own_priors", [False, True])
@pytest.mark.parametrize("kind", LINKS)
@pytest.mark.parametrize("d", [1, 2, 4])
def test_information_is_the_expected_hessian_of_autograd(kind, d, own_priors, rng):
    """The Hessian is linear in the scatter, so its expectation is that at the expected scatter."""
    link = make_link(kind, d, rng, 3 if own_priors else None)
    deviation, (_, counts) = deviations(link, 3, rng), scatters(link, 3, rng)
    expected_root = counts.sqrt()[:, None, None] * scale_tril_from_root(with_floor(link.root(deviation)))

    def nll(flat):
        return gaussian_nll(link.root(flat.reshape(deviation.shape)), expected_root, counts)

    hessian = torch.autograd.functional.hessian(nll, deviation.flatten())
    cost = Likelihood(link, expected_root, counts, 1.0)
    found = block_diagonal(cost.curvature(cost.covariances(deviation), 0.0), 3, n_processes(link))
    torch.testing.assert_close(found, hessian, rtol=1e-7, atol=1e-7 * float(hessian.abs().max()))


@pytest.mark.parametrize("d", [1, 2, 4])
def test_observed_information_is_the_hessian_of_autograd(d, rng):
    link = make_link("wishart", d, rng)
    deviation, (scatter_root, counts) = deviations(link, 3, rng), scatters(link, 3, rng)

    def nll(flat):
        return gaussian_nll(link.root(flat.reshape(deviation.shape)), scatter_root, counts)

    hessian = torch.autograd.functional.hessian(nll, deviation.flatten())
    cost = Likelihood(link, scatter_root, counts, 1.0)
    point = cost.covariances(deviation)
    found = [block_diagonal(cost.curvature(point, share), 3, n_processes(link)) for share in (0.0, 0.25, 1.0)]
    scale = float(hessian.abs().max())
    torch.testing.assert_close(found[2], hessian, rtol=1e-7, atol=1e-7 * scale)
    torch.testing.assert_close(found[1], 0.75 * found[0] + 0.25 * found[2], rtol=1e-12, atol=1e-12 * scale)


def problem(kind, counts, d, rng, length_scale=0.3):
    """Cost of residuals whose covariance changes, latent values as the regressors start them, one over the rows."""
    index = np.repeat(np.arange(len(counts)), counts)
    inputs = np.linspace(-0.5, 0.5, len(counts))[:, None]
    factor = np.eye(d) + 0.3 * np.cos(3.0 * inputs)[:, :, None] * np.tril(rng.normal(size=(d, d)))
    residual = (factor[index] @ rng.normal(size=(len(index), d, 1)))[..., 0]
    training = TrainingSet(tensor(inputs[index]), tensor(residual), tensor(inputs), tensor(index).long())
    pooled = tensor(np.linalg.cholesky(residual.T @ residual / len(index) + 1e-6 * np.eye(d)))
    prior = 2.0 * pooled
    if kind == "wishart":
        link = WishartLink(padded(prior, d + 1))
        start = link.deviation(padded(pooled, d + 1))
        amplitude = prior.norm(dim=1).repeat(d + 1)
    else:
        link = CholeskyLink(prior, kind == "cholesky-log")
        start = link.deviation(pooled)
        row, column = np.tril_indices(d)
        amplitude = prior.norm(dim=1)[row]
        if link.log_diagonal:
            amplitude[row == column] = 2.0
    torch.testing.assert_close(link.amplitude(), amplitude, rtol=1e-12, atol=0)
    cost = Likelihood(link, training.scatter_root(training.y), training.counts, 1.0 / len(index))
    latent = LatentValues(
        training.inputs, start.expand(len(counts), -1).mT.contiguous(), amplitude, tensor([[length_scale]])
    )
    with torch.no_grad():  # vectors that start equal stay so
        latent.whitened += 0.01 * tensor(rng.normal(size=latent.whitened.shape))
    return cost, latent, 1.0 / len(index)


def trained(kind, counts, d, solver, tol=1e-11, max_iter=3000):
    cost, latent, _ = problem(kind, counts, d, np.random.default_rng(0))
    report = train(cost, latent, solver=solver, max_iter=max_iter, tol=tol)
    with torch.no_grad():
        root = cost.link.root(latent())
    return report, root @ root.mT


@pytest.mark.parametrize(
    ("kind", "d", "counts"),
    [(kind, d, counts) for kind in LINKS[:2] for d in (1, 2) for counts in COUNTS]
    + [("cholesky-log", 9, "aligned"), ("cholesky", 9, "many"), ("cholesky-log", 9, "many")]
    + [("wishart", 1, counts) for counts in COUNTS],
)
def test_both_solvers_end_at_the_same_optimum(kind, d, counts):
    counts = [1] * 400 if counts == "many" else COUNTS[counts]
    by_fisher, by_lbfgs = (trained(kind, counts, d, solver) for solver in ("fisher", "lbfgs"))
    assert by_fisher[0].converged
    assert by_fisher[0].n_iter < 50
    assert sum(counts) * by_fisher[0].loss == pytest.approx(sum(counts) * by_lbfgs[0].loss, abs=1e-6)
    torch.testing.assert_close(by_fisher[1], by_lbfgs[1], rtol=0, atol=1e-3 * float(by_fisher[1].max()))


@pytest.mark.parametrize("counts", ["aligned", "ragged"])
def test_scoring_ends_below_lbfgs_where_vectors_may_turn(counts):
    """L-BFGS crawls along the valleys in which the vectors of a Wishart process turn: here it gets 400 steps."""
    by_fisher = trained("wishart", COUNTS[counts], 2, "fisher")[0]
    by_lbfgs = trained("wishart", COUNTS[counts], 2, "lbfgs", max_iter=400)[0]
    assert by_fisher.converged
    assert by_fisher.n_iter < 100
    assert sum(COUNTS[counts]) * (by_lbfgs.loss - by_fisher.loss) == pytest.approx(0.005, abs=0.005)


@pytest.mark.parametrize("kind", LINKS)
def test_the_optimum_is_that_of_scipy(kind, rng):
    cost, latent, weight = problem(kind, [12] * 6, 2, rng)
    start = latent.whitened.detach().clone()
    basis, amplitude = latent.basis[0], latent.log_amplitude.detach().exp()

    def objective(flat):
        """The posterior density anew, with the root of the kernel matrix and autograd."""
        whitened = tensor(flat).reshape(start.shape).requires_grad_()
        deviation = (whitened * amplitude[:, None]) @ basis.mT
        nll = gaussian_nll(cost.link.root(deviation.mT), cost._rows[0], cost._rows[1][:, 0, 0])
        loss = nll + 0.5 * whitened.square().sum()
        (gradient,) = torch.autograd.grad(loss, whitened)
        return loss.item(), gradient.flatten().numpy()

    expected = scipy_minimize(objective, start.flatten().numpy(), jac=True, method="BFGS", options={"gtol": 1e-7})
    report = train(cost, latent, solver="auto", max_iter=200, tol=1e-11)
    assert report.converged
    assert report.loss / weight == pytest.approx(expected.fun, abs=1e-7)
    assert objective(latent.whitened.detach().flatten().numpy())[0] == pytest.approx(report.loss / weight, abs=1e-9)


@pytest.mark.parametrize("solver", ["fisher", "lbfgs"])
@pytest.mark.parametrize("kind", LINKS)
def test_training_never_ends_above_its_start(kind, solver, rng):
    cost, latent, weight = problem(kind, [1] * 20, 2, rng)
    with torch.no_grad():
        latent.whitened.mul_(3.0)
        start = float(cost(latent()) + 0.5 * weight * latent.whitened.square().sum())
    curve = []
    report = train(
        cost,
        latent,
        solver=solver,
        max_iter=3,
        tol=1e-9,
        callback=lambda progress: curve.append(progress.loss),
    )
    assert report.loss_curve[0] == pytest.approx(start, rel=1e-12)
    assert list(report.loss_curve) == sorted(report.loss_curve, reverse=True) == curve
    with torch.no_grad():
        end = float(cost(latent()) + 0.5 * weight * latent.whitened.square().sum())
    assert end == pytest.approx(report.loss, rel=1e-12)
    assert report.loss < start
    assert not report.converged


def test_preconditioned_lbfgs_needs_few_evaluations():
    """At the start its coordinates make the curvature the unit matrix."""
    report, _ = trained("cholesky-log", COUNTS["not aligned"], 2, "lbfgs", tol=1e-7)
    optimum = trained("cholesky-log", COUNTS["not aligned"], 2, "fisher")[0].loss
    assert (report.loss - optimum) * 60 < 1e-3
    assert len(report.loss_curve) <= 25


def test_auto_is_fisher_scoring_unless_a_block_is_too_large(monkeypatch):
    for largest, solver in [(10_000, "fisher"), (1, "lbfgs")]:
        monkeypatch.setattr(CholeskyLink, "largest_block", largest)
        auto, chosen = (trained("cholesky-log", [5] * 6, 2, name)[0] for name in ("auto", solver))
        assert auto.loss_curve == chosen.loss_curve
