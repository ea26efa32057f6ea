import numpy as np
import pytest
import torch

from torch_pbd.models.heteroscedastic.residuals import DemonstrationCorrelation, demonstration_correlation
from torch_pbd.models.training import TrainingSet


def known(group, *decays):
    decay = torch.tensor(decays, dtype=torch.float64)
    return DemonstrationCorrelation(decay, torch.where(decay > 0, 0.1, 1.0).double(), torch.tensor(group))


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
    assert np.median([each.decay.numpy() for each in found]) == pytest.approx(decay, rel=0.2)
    x = np.linspace(-0.5, 0.5, 100)
    total = np.triu(np.exp(-np.abs(np.subtract.outer(x, x)) / decay), 1).sum()
    share = np.median([each.share.numpy() for each in found])
    assert share == pytest.approx(1.0 / (1.0 + 2.0 * total / 100.0), rel=0.2)


@pytest.mark.parametrize(("n_demos", "n_steps", "d"), [(50, 10, 2), (6, 100, 2), (12, 40, 1), (8, 50, 9)])
def test_independent_draws_are_taken_for_independent_exactly(n_demos, n_steps, d):
    for seed in range(20):
        rows = curves(0.0, seed, n_demos=n_demos, n_steps=n_steps, d=d)
        assert demonstration_correlation(*rows) is None


def test_of_one_demonstration_nothing_is_learned():
    assert demonstration_correlation(*curves(0.1, 0, n_demos=1)) is None


def test_each_output_has_its_own():
    """A smooth output beside one of independent samples: neither changes what is found of the other."""
    x, smooth, group = curves(0.1, 0)
    _, rough, _ = curves(0.0, 1)
    found = demonstration_correlation(x, torch.stack([smooth[:, 0], rough[:, 0]], dim=1), group)
    alone = demonstration_correlation(x, smooth[:, :1], group)
    assert found.decay[0] == pytest.approx(float(alone.decay[0]), rel=1e-9)
    assert (float(found.decay[1]), float(found.share[1])) == (0.0, 1.0)


def test_neither_order_nor_names_nor_units_matter():
    x, values, group = curves(0.1, 0)
    expected = demonstration_correlation(x, values, group)
    order = torch.tensor(np.random.default_rng(0).permutation(len(x)))
    for found in (
        demonstration_correlation(x[order], values[order], group[order]),
        demonstration_correlation(x, values, (7 * group + 3) % 20),
        demonstration_correlation(x, values * torch.tensor([1e-6, 1e3]).double(), group),
    ):
        torch.testing.assert_close(found.decay, expected.decay, rtol=1e-9, atol=0)
        torch.testing.assert_close(found.share, expected.share, rtol=1e-9, atol=0)


def test_of_long_demonstrations_every_third_sample_tells_the_same():
    """Of a thousand samples 334 are looked at, and the sum over all pairs is that many times as large."""
    x, values, group = curves(0.1, 0, n_demos=6, n_steps=1000)
    whole = demonstration_correlation(x, values, group)
    kept = (torch.arange(1000) % 3 == 0).repeat(6)
    part = demonstration_correlation(x[kept], values[kept], group[kept])
    # The variance that residuals are divided by is of all samples here, and there of a third.
    torch.testing.assert_close(whole.decay, part.decay, rtol=1e-2, atol=0)
    torch.testing.assert_close(1.0 / whole.share - 1.0, (1.0 / part.share - 1.0) * 1000 / 334, rtol=1e-2, atol=0)


def test_the_whiteners_take_out_the_correlation_of_means_of_rows(rng):
    """Covariance of all rows by definition, averaged at the inputs: of mixed counts, and demonstrations that miss
    some inputs and repeat others.
    """
    x = np.sort(rng.uniform(-0.5, 0.5, size=6))
    index = np.concatenate([np.arange(6), rng.integers(6, size=20)])
    group = np.concatenate([np.arange(6) % 4, rng.integers(4, size=20)])
    inputs, index_of = torch.tensor(x)[:, None], torch.tensor(index)
    rows = TrainingSet(inputs[index_of], torch.zeros(26, 1).double(), inputs, index_of)
    means, squares = (known(group, 0.2, 0.0).at_inputs(rows, squares=each) for each in (False, True))
    average = (np.arange(6)[:, np.newaxis] == index) / np.sqrt(np.bincount(index))[:, np.newaxis]
    distance = np.abs(np.subtract.outer(x[index], x[index]))
    for (whitener, copies), decay in ((means, 0.4), (squares, 0.2)):
        rows = np.exp(-distance / decay) * (group[:, np.newaxis] == group)
        covariance = average @ rows @ average.T
        whitened = whitener[0].numpy() @ covariance @ whitener[0].numpy().T
        np.testing.assert_allclose(whitened, np.eye(6), rtol=0, atol=1e-10)
        np.testing.assert_allclose(copies[0], np.diag(covariance), rtol=1e-12)
        np.testing.assert_array_equal(whitener[1], np.eye(6))  # of the output whose samples are independent
    assert squares.copies[0].max() > 1.0  # some demonstration repeats an input
