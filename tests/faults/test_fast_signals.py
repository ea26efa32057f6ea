"""A fast mean is followed as closely as scikit-learn follows it, and rows of demonstrations are known as such."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.model_selection import GridSearchCV, GroupKFold

from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.data import make_paper_simulation
from torch_pbd.exceptions import DataRankWarning


def strokes(x, cycles):
    """Around a square, one side after another: the height, of range one, with corners."""
    side, along = np.divmod(4.0 * np.mod(cycles * x, 1.0), 1.0)
    return np.choose(side.astype(int), [along, 1.0 + 0.0 * x, 1.0 - along, 0.0 * x])


SIGNALS = {
    "sine": lambda x, cycles: np.sin(2.0 * np.pi * cycles * x),
    "chirp": lambda x, cycles: np.sin(2.0 * np.pi * (2.0 * x + 0.5 * (cycles - 2.0) * x**2)),
    "burst": lambda x, cycles: np.exp(-0.5 * np.square((x - 0.5) / 0.08)) * np.sin(2.0 * np.pi * cycles * x),
    "trend": lambda x, cycles: 3.0 * x + 0.3 * np.sin(2.0 * np.pi * cycles * x),
    "strokes": strokes,
}


def allowed(x, y, truth, cycles, n_restarts):
    """Twice the error of scikit-learn's mean, but a ten-thousandth of the range at least."""
    kernel = ConstantKernel() * RBF(np.ptp(x) / cycles, (1e-4, 1e3)) + WhiteKernel(1e-2, (1e-14, 1e2))
    peer = GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=n_restarts, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        peer.fit(x[:, np.newaxis], y)
    error = np.sqrt(np.mean(np.square(peer.predict(x[:, np.newaxis]) - truth)))
    return max(2.0 * error, 1e-4 * np.ptp(truth))


def check(kind, n_rows, cycles, *, noise=0.0, n_recordings=1, grouped=False, n_restarts=0, unit=1.0, origin=0.0):
    """Fit without a warning (but that one recording is one), and compare the means at the inputs."""
    rng = np.random.default_rng(0)
    x = np.linspace(0.0, 1.0, n_rows)
    truth = SIGNALS[kind](x, cycles)
    y = truth + noise * rng.normal(size=(n_recordings, n_rows))
    X = np.tile(origin + unit * x, n_recordings)[:, np.newaxis]
    groups = np.repeat(np.arange(n_recordings), n_rows) if grouped else None
    model = HeteroscedasticGPRegressor().fit(X, unit * y.ravel(), groups=groups)
    error = np.sqrt(np.mean(np.square(model.predict(X[:n_rows]) / unit - truth)))
    assert error <= allowed(x, y.mean(0), truth, cycles, n_restarts)
    return model


# --- fast means


def test_the_signal_that_was_taken_for_noise():
    """Its mean was below .03 everywhere, and nothing was said."""
    check("sine", 308, 15)


@pytest.mark.parametrize("kind", SIGNALS)
@pytest.mark.parametrize(("n_rows", "cycles"), [(40, 6), (60, 10)])
def test_six_samples_a_cycle_are_enough(kind, n_rows, cycles):
    check(kind, n_rows, cycles)


@pytest.mark.parametrize("kind", ["sine", "strokes"])
@pytest.mark.parametrize("grouped", [False, True])
def test_recordings_of_the_same_inputs_are_followed(kind, grouped):
    check(kind, 60, 9, noise=0.03, n_recordings=3, grouped=grouped)


def test_the_units_of_a_fast_signal_do_not_matter():
    model = check("sine", 60, 10, noise=0.02)
    other = check("sine", 60, 10, noise=0.02, unit=1000.0, origin=1.7e9)
    X = np.linspace(0.0, 1.0, 119)[:, np.newaxis]
    # A time of 1.7e9 s has 2e-7 s of resolution.
    np.testing.assert_allclose(other.predict(1.7e9 + 1000.0 * X) / 1000.0, model.predict(X), rtol=0, atol=1e-5)


def test_a_slow_signal_without_noise_is_followed_to_the_ten_thousandth():
    """The noise was estimated from what neighbours differ by, here signal: the mean was off by a thousandth."""
    check("sine", 60, 3)


RECORDED = [(0, 1, False), (0.05, 3, False), (0.05, 3, True)]  # noise, recordings, whether they are told apart


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "share", "n_rows", "noise", "n_recordings", "grouped"),
    [  # each of two with each of any other, not all with all
        (kind, share, n_rows, *RECORDED[(place + other + long) % 3])
        for place, kind in enumerate(SIGNALS)
        for other, share in enumerate([12, 8, 6])
        for long, n_rows in enumerate([60, 300])
    ],
)
def test_fast_signals_of_many_kinds(kind, share, n_rows, noise, n_recordings, grouped):
    check(kind, n_rows, n_rows / share, noise=noise, n_recordings=n_recordings, grouped=grouped, n_restarts=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "n_rows", "cycles"), [("sine", 1000, 166), ("burst", 1000, 120), ("chirp", 5000, 100)]
)
def test_long_recordings_of_fast_signals(kind, n_rows, cycles):
    """Without scikit-learn, which takes minutes: signals without noise have no error but the allowed one."""
    x = np.linspace(0.0, 1.0, n_rows)
    truth = SIGNALS[kind](x, cycles)
    mean = HeteroscedasticGPRegressor().fit(x[:, np.newaxis], truth).predict(x[:, np.newaxis])
    assert np.sqrt(np.mean(np.square(mean - truth))) <= 1e-4 * np.ptp(truth)


def test_a_signal_that_is_not_followed_is_told():
    """Four inducing inputs, as the user wants it, cannot follow eight cycles."""
    x = np.linspace(0.0, 1.0, 100)
    with pytest.warns(UserWarning, match=r"does not follow y in outputs \[1\].*n_inducing"):
        HeteroscedasticGPRegressor(n_inducing=4).fit(
            x[:, np.newaxis], np.column_stack([x, SIGNALS["sine"](x, 8)]) + 0.01 * np.cos(1e4 * x[:, np.newaxis])
        )


# --- demonstrations without groups


def smooth(n_demos=5, n_steps=30, d=1, jitter=0.0, seed=0):
    """Smooth deviations from a bend, at common inputs or each demonstration at its own."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 1.0, n_steps) + jitter * rng.uniform(-0.5, 0.5, size=(n_demos, n_steps)) / n_steps
    waves = np.stack([f(np.pi * k * x) / k for k in range(1, 6) for f in (np.sin, np.cos)], axis=-1)
    y = np.sin(3.0 * x)[..., np.newaxis] + 0.3 * waves @ rng.normal(size=(n_demos, 10, d))
    return x.reshape(-1, 1), y.reshape(-1, d), np.repeat(np.arange(n_demos), n_steps)


@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_demonstrations_without_groups_are_told(jitter):
    X, y, groups = smooth(jitter=jitter)
    with pytest.warns(DataRankWarning, match="Give groups") as told:
        HeteroscedasticGPRegressor().fit(X, y)
    assert len(told) == 1
    HeteroscedasticGPRegressor().fit(X, y, groups=groups)  # without a warning


@pytest.mark.parametrize("order", ["by time", "shuffled"])
def test_aligned_demonstrations_are_told_in_any_order_of_the_rows(order):
    X, y, _ = smooth()
    rows = np.argsort(X[:, 0], kind="stable") if order == "by time" else np.random.default_rng(0).permutation(len(X))
    with pytest.warns(DataRankWarning, match="Give groups"):
        HeteroscedasticGPRegressor().fit(X[rows], y[rows])


def test_a_search_that_drops_the_groups_is_told_of():
    X, y, groups = smooth(jitter=1.0)
    search = GridSearchCV(HeteroscedasticGPRegressor(), {"tol": [1e-2]}, cv=GroupKFold(2))
    with pytest.warns(DataRankWarning, match="metadata routing"):
        search.fit(X, y, groups=groups)


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_independent_draws_raise_no_alarm(aligned, seed):
    """Warnings are errors here. Of 10,000 draws of white noise none was taken for copies."""
    X, y, _ = make_paper_simulation(*((20, 8) if aligned else (160, 1)), random_state=seed)
    HeteroscedasticGPRegressor().fit(X, y)


def test_doubts_about_a_sound_draw_change_nothing(monkeypatch):
    """Of these 500 rows, much louder at one end, the first mean's residuals are not white; the KL rose by a half."""
    from torch_pbd.models.heteroscedastic.fit import HeteroscedasticFit

    X, y, _ = make_paper_simulation(500, 1, reading="printed", random_state=0)
    fits = []
    for follows in (False, True):
        monkeypatch.setattr(HeteroscedasticFit, "_follows", lambda _, answer=follows: answer)
        fits.append(HeteroscedasticGPRegressor().fit(X, y).predict(X, return_cov=True))
    for looked_again, sure in zip(*fits, strict=True):
        np.testing.assert_array_equal(looked_again, sure)


def test_outputs_that_vary_together_raise_no_alarm():
    """Of the second nothing is left beyond the first but rounding, which is no signal that the mean misses."""
    time = np.linspace(0.0, 2.0, 100)
    X, shifts = np.tile(time, 4)[:, None], np.repeat(0.01 * np.arange(4.0), 100)
    y = np.column_stack([np.tile(time**2 * (3.0 - time) / 4.0, 4), np.zeros(400)]) + shifts[:, None]
    HeteroscedasticGPRegressor().fit(X, y, groups=np.repeat(np.arange(4), 100))


@pytest.mark.parametrize("kind", ["normal", "heavy tails", "skewed", "louder along the input"])
@pytest.mark.parametrize("layout", ["demonstrations", "scattered"])
def test_white_noise_is_taken_for_white(kind, layout):
    """At most one alarm of either kind in a hundred draws; 100 of each here."""
    import torch

    from torch_pbd.models.heteroscedastic.residuals import NOT_WHITE, are_copies, is_signal
    from torch_pbd.models.training import TrainingSet

    rng, alarms, n_rows = np.random.default_rng(0), 0, 90
    for _ in range(100):
        x = np.tile(np.linspace(0.0, 1.0, 30), 3) if layout == "demonstrations" else rng.uniform(size=n_rows)
        noise = {
            "normal": rng.normal(size=(n_rows, 2)),
            "heavy tails": rng.standard_t(3, size=(n_rows, 2)),
            "skewed": rng.exponential(size=(n_rows, 2)) - 1.0,
            "louder along the input": np.exp(2.0 * x)[:, np.newaxis] * rng.normal(size=(n_rows, 2)),
        }[kind]
        inputs, index = np.unique(x, return_inverse=True)
        y, order = torch.tensor(noise), torch.arange(n_rows)
        rows = TrainingSet(torch.tensor(x)[:, None], y, torch.tensor(inputs)[:, None], torch.tensor(index))
        alarms += are_copies(y, rows, order) or bool(is_signal(y, rows, None, NOT_WHITE).any())
    assert alarms <= 1
