import numpy as np
import pytest
import torch

from torch_pbd.models.heteroscedastic.correlation import (
    INDEPENDENT,
    DemonstrationCorrelation,
    NoiseCorrelation,
    demonstration_correlation,
)


def curves(decay, seed, *, n_demos=20, n_steps=100, d=2):
    """Ornstein-Uhlenbeck curves of unit variance, whose squares are correlated by exp(-distance / decay)."""
    rng = np.random.default_rng(seed)
    x = np.linspace(-0.5, 0.5, n_steps)
    if decay == 0.0:
        values = rng.normal(size=(n_demos, n_steps, d))
    else:
        factor = np.linalg.cholesky(np.exp(-np.abs(np.subtract.outer(x, x)) / (2.0 * decay)))
        values = factor @ rng.normal(size=(n_demos, n_steps, d))
    group = np.repeat(np.arange(n_demos), n_steps)
    return torch.tensor(np.tile(x, n_demos)[:, np.newaxis]), torch.tensor(values.reshape(-1, d)), torch.tensor(group)


@pytest.mark.parametrize("decay", [0.02, 0.05, 0.15])
def test_the_decay_of_curves_of_known_correlation_is_found(decay):
    """The median of 20 seeds within a fifth; the share is that of the sum of its squares over all pairs."""
    found = [demonstration_correlation(*curves(decay, seed)) for seed in range(20)]
    assert np.median([each.decay for each in found]) == pytest.approx(decay, rel=0.2)
    x = np.linspace(-0.5, 0.5, 100)
    total = np.triu(np.exp(-np.abs(np.subtract.outer(x, x)) / decay), 1).sum()
    share = np.median([each.effective_share for each in found])
    assert share == pytest.approx(1.0 / (1.0 + 2.0 * total / 100.0), rel=0.2)


@pytest.mark.parametrize(("n_demos", "n_steps", "d"), [(50, 10, 2), (6, 100, 2), (12, 40, 1), (8, 50, 9)])
def test_independent_draws_are_taken_for_independent_exactly(n_demos, n_steps, d):
    for seed in range(20):
        rows = curves(0.0, seed, n_demos=n_demos, n_steps=n_steps, d=d)
        assert demonstration_correlation(*rows) == DemonstrationCorrelation(0.0, 1.0)


def test_of_one_demonstration_nothing_is_learned():
    assert demonstration_correlation(*curves(0.1, 0, n_demos=1)) == INDEPENDENT


def test_neither_order_nor_names_nor_units_matter():
    x, values, group = curves(0.1, 0)
    expected = demonstration_correlation(x, values, group)
    order = torch.tensor(np.random.default_rng(0).permutation(len(x)))
    for found in (
        demonstration_correlation(x[order], values[order], group[order]),
        demonstration_correlation(x, values, (7 * group + 3) % 20),
        demonstration_correlation(x, values * torch.tensor([1e-6, 1e3]).double(), group),
    ):
        assert found.decay == pytest.approx(expected.decay, rel=1e-9)
        assert found.effective_share == pytest.approx(expected.effective_share, rel=1e-9)


def test_of_long_demonstrations_every_third_sample_tells_the_same():
    """Of a thousand samples 334 are looked at, and the sum over all pairs is that many times as large."""
    x, values, group = curves(0.1, 0, n_demos=6, n_steps=1000)
    whole = demonstration_correlation(x, values, group)
    kept = (torch.arange(1000) % 3 == 0).repeat(6)
    part = demonstration_correlation(x[kept], values[kept], group[kept])
    # The variance that residuals are divided by is of all samples here, and there of a third.
    assert whole.decay == pytest.approx(part.decay, rel=1e-2)
    assert 1.0 / whole.effective_share - 1.0 == pytest.approx((1.0 / part.effective_share - 1.0) * 1000 / 334, rel=1e-2)


def test_the_whiteners_take_out_the_correlation_of_means_of_rows(rng):
    """Covariance of all rows by definition, averaged at the inputs: of mixed counts, and demonstrations that miss
    some inputs and repeat others.
    """
    x = np.sort(rng.uniform(-0.5, 0.5, size=6))
    index = np.concatenate([np.arange(6), rng.integers(6, size=20)])
    group = np.concatenate([np.arange(6) % 4, rng.integers(4, size=20)])
    arguments = (torch.tensor(x)[:, None], torch.tensor(index), torch.tensor(group))
    noise = NoiseCorrelation.of(DemonstrationCorrelation(0.2, 0.1), *arguments)
    average = (np.arange(6)[:, np.newaxis] == index) / np.sqrt(np.bincount(index))[:, np.newaxis]
    distance = np.abs(np.subtract.outer(x[index], x[index]))
    for whitener, decay in ((noise.of_means, 0.4), (noise.of_squares, 0.2)):
        rows = np.exp(-distance / decay) * (group[:, np.newaxis] == group)
        covariance = average @ rows @ average.T
        whitened = whitener.numpy() @ covariance @ whitener.numpy().T
        np.testing.assert_allclose(whitened, np.eye(6), rtol=0, atol=1e-10)
        np.testing.assert_allclose(noise.copies, np.diag(covariance), rtol=1e-12)
    assert noise.copies.max() > 1.0  # some demonstration repeats an input


@pytest.mark.parametrize("correlation", [INDEPENDENT, DemonstrationCorrelation(0.2, 0.1)])
def test_without_correlation_or_groups_there_is_nothing_to_take_out(correlation):
    group = None if correlation.decay else torch.tensor([0, 0, 1])
    noise = NoiseCorrelation.of(correlation, torch.zeros(3, 1).double(), torch.arange(3), group)
    assert noise == NoiseCorrelation(None, None, None)
