"""The benchmark of covariance regressors: its laws, its peers, its command line."""

import csv

import covariance
import covariance_libraries as libraries
import covariance_peers as peers
import covariance_report as tables
import covariance_tasks as made
import numpy as np
import pytest

from torch_pbd.data import make_tunnel_demonstrations, save_demonstrations


def test_laws_have_the_values_of_their_formulas():
    origin = np.zeros((1, 1))
    np.testing.assert_allclose(made.oscillating(origin)[1][0], [[144.0, 0.0], [0.0, 225.0]], rtol=1e-12)
    np.testing.assert_allclose(made.rotating_tunnel(origin)[1][0], [[121.0, 0.0], [0.0, 9.0]], rtol=1e-12)
    np.testing.assert_allclose(made.plane(np.zeros((1, 2)))[1][0], [[155.0, 0.0], [0.0, 150.0]], rtol=1e-12)
    turned = made.plane(np.array([[100.0, 0.0]]))[1][0]  # by a right angle: the axes change places
    np.testing.assert_allclose(turned, [[150.0, 0.0], [0.0, 5.0 + 150.0 * np.exp(-4.0)]], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in made.TASKS if name != "two-inputs"])
def test_draws_of_a_task_have_its_law(name):
    # Whitened by the law, interpolated from the grid, draws have unit covariance in each quarter of the range. The
    # bounds are four standard errors: a smooth curve counts as about 1 + range / (2 length) draws a quarter.
    outer = [[] for _ in range(4)]
    for seed in range(60):
        task = made.TASKS[name](seed)
        at, grid = task.X[:, 0], task.X_test[:, 0]
        mean = np.column_stack([np.interp(at, grid, column) for column in task.mean.T])
        entries = [np.interp(at, grid, column) for column in task.covariance.reshape(-1, 4).T]
        factor = np.linalg.cholesky(np.stack(entries, axis=-1).reshape(-1, 2, 2))
        white = np.linalg.solve(factor, (task.y - mean)[..., np.newaxis])[..., 0]
        for quarter in range(4):
            rows = white[np.digitize(at, [-50.0, 0.0, 50.0]) == quarter]
            outer[quarter].append(rows.T @ rows / len(rows))
    n_draws = 60 * 6 if "smooth" in name else 60 * 100
    for covariances in outer:
        np.testing.assert_allclose(np.mean(covariances, axis=0), np.eye(2), atol=4.0 * (2.0 / n_draws) ** 0.5)


def test_draws_of_two_inputs_have_their_law(rng):
    at = np.repeat([[60.0, -40.0]], 40_000, axis=0)
    mean, covariances = made.plane(at[:1])
    y = made.draw(made.plane, at, rng)
    np.testing.assert_allclose(y.mean(axis=0), mean[0], atol=0.3)  # five standard errors
    np.testing.assert_allclose(np.cov(y.T), covariances[0], rtol=0.04, atol=2.0)


def test_aligned_rows_repeat_and_unaligned_ones_do_not():
    aligned, unaligned = made.TASKS["tunnel-aligned"](0), made.TASKS["tunnel-unaligned"](0)
    assert (len(np.unique(aligned.X)), len(np.unique(aligned.groups))) == (10, 50)
    assert len(np.unique(unaligned.X)) == 500
    assert unaligned.groups is None


@pytest.mark.parametrize(("length", "better"), [(0.05, 0.01), (50.0, 0.4)])
def test_smoother_picks_the_better_bandwidth(length, better, rng):
    def draws(n_demos):
        x = np.tile(np.linspace(0.0, 1.0, 40), n_demos)[:, np.newaxis]
        scale = np.exp(1.5 * np.sin(x / length))
        return x, scale * rng.normal(size=(len(x), 2)), np.repeat(np.arange(n_demos), 40)

    x, y, groups = draws(20)
    x_new, y_new, _ = draws(200)
    alone = {h: peers.KernelSmoother((h,)).fit(x, y, groups) for h in (0.01, 0.4)}
    assert max(alone, key=lambda h: alone[h].log_likelihood(x_new, y_new).mean()) == better
    assert peers.KernelSmoother((0.01, 0.4)).fit(x, y, groups).bandwidths_[1] == better


def test_left_out_means_are_those_of_the_other_demonstrations(rng):
    x, y = np.tile(np.linspace(0.0, 1.0, 5), 4)[:, np.newaxis], rng.normal(size=(20, 2))
    groups = np.repeat(np.arange(4), 5)
    smoother = peers.KernelSmoother((0.3,)).fit(x, y, groups)
    weights = np.exp(-0.5 * np.square((np.unique(x)[:, np.newaxis] - np.unique(x)) / 0.3))
    expected = np.empty_like(y)
    for i in range(20):
        others = groups != groups[i]
        nearness = np.exp(-0.5 * np.square((x[others, 0] - x[i, 0]) / 0.3))
        expected[i] = nearness @ y[others] / nearness.sum()
    np.testing.assert_allclose(smoother._without_own(weights, y), expected, rtol=1e-9)


def test_mixture_regression_is_that_of_gmr(rng):
    gmr = pytest.importorskip("gmr")
    x = rng.uniform(-3.0, 5.0, size=(200, 1))
    y = np.hstack([np.sin(x), x**2]) + 0.3 * rng.normal(size=(200, 2))
    model = libraries.MixtureRegression(3, own_density=True).fit(x, y)
    weights, means, covariances = model.mixture_
    mixture = gmr.GMM(3, weights, means, covariances)
    shift, scale = model._shift, model._scale  # of the mixture, inside of the peer's own
    inputs, outputs = model._inputs(x[:5]), (y[:5] - model._y_mean) / model._y_scale
    mean, covariance_ = model._moments(inputs)
    density = model._log_density(inputs, outputs)
    for i in range(5):
        conditional = mixture.condition([0], (inputs[i] - shift[:1]) / scale[:1])
        normal = conditional.to_mvn()
        np.testing.assert_allclose(mean[i], shift[1:] + scale[1:] * normal.mean, rtol=1e-9)
        np.testing.assert_allclose(covariance_[i], np.outer(scale[1:], scale[1:]) * normal.covariance, rtol=1e-9)
        expected = conditional.to_probability_density((outputs[i : i + 1] - shift[1:]) / scale[1:])[0]
        np.testing.assert_allclose(density[i], np.log(expected) - np.log(scale[1:]).sum(), rtol=1e-9, atol=1e-9)


def test_density_of_the_reference_is_a_student_t(rng):
    from scipy.stats import multivariate_t

    x = np.tile(np.linspace(0.0, 2.0, 4), 6)[:, np.newaxis]
    y = rng.normal(size=(24, 2)) * [1.0, 20.0]
    model = peers.StudentReference().fit(x, y)
    mean, covariance_ = model.predict(x[:4])
    df = 4 + 6 + 1
    expected = [
        multivariate_t(m, c * (df - 2) / df, df).logpdf(row) for m, c, row in zip(mean, covariance_, y[:4], strict=True)
    ]
    np.testing.assert_allclose(model.log_likelihood(x[:4], y[:4]), expected, rtol=1e-9)


def test_a_failed_fit_is_reported():
    def broken():
        raise np.linalg.LinAlgError("singular")

    assert covariance.attempt(broken) == {"note": "failed: LinAlgError: singular"}
    rows = [{"task": "t", "seed": 0, "method": "m", "note": "failed: LinAlgError: singular"}]
    text = tables.report(rows, [], [])
    assert "0/1" in text
    assert "- m failed: LinAlgError: singular" in text


def test_paired_differences():
    values = {"a": [1.0, 2.0, 4.0], "b": [0.0, 2.0, 1.0]}
    rows = [
        {"fold": fold, "method": method, "log_likelihood": value, "fit_seconds": 0.0}
        for method, several in values.items()
        for fold, value in enumerate(several)
    ]
    difference, error, whole = tables.paired(rows, "a", "b")
    np.testing.assert_allclose([difference, error], [4.0 / 3.0, np.std([1.0, 0.0, 3.0], ddof=1) / 3**0.5], rtol=1e-12)
    assert whole
    assert not tables.paired(rows[:-1], "a", "b")[2]


def test_command_line_writes_every_seed_and_fold_and_the_table(tmp_path, capsys):
    data = tmp_path / "data"
    data.mkdir()
    recorded = make_tunnel_demonstrations(5, duration=1.0, rate=20.0, random_state=0)
    save_demonstrations(recorded, data / "tunnel.npz")
    out = tmp_path / "out"
    methods = ["constant", "reference"]
    options = ["--tasks", "bell-aligned", "--methods", *methods, "--seeds", "1", "--max-folds", "2"]
    covariance.main([*options, "--data", str(data), "--out", str(out)])
    for name, n_rows in [("made", 2), ("recorded", 4)]:
        with (out / f"{name}.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == n_rows
        assert {row["method"] for row in rows} == set(methods)
        assert all(float(row["fit_seconds"]) > 0 for row in rows)
    table = (out / "table.md").read_text(encoding="utf-8")
    assert "## bell-aligned" in table
    assert "## tunnel" in table
    assert table in capsys.readouterr().out


def test_command_line_says_that_there_are_no_recordings(tmp_path, capsys):
    covariance.main(["--tasks", "--data", str(tmp_path / "none"), "--out", str(tmp_path)])
    assert "recordings are skipped" in capsys.readouterr().out
