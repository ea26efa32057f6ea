"""ProMP and KMP against the published packages, and the laws that all models of movements share."""

import pickle

import numpy as np
import pytest
import sklearn
from lc_ns_kmp import LC_NS_KMP
from movement_primitives.promp import ProMP
from scipy.stats import multivariate_normal, multivariate_t
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process.kernels import RBF
from sklearn.model_selection import GroupKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler

from movement.test_trajectory import GRID, gaussian_conditional, movements, stacked
from torch_pbd import Demonstrations, KMPBaseline, ProMPBaseline, TrajectoryRegressor, load_demonstrations
from torch_pbd.data.demonstrations import Demonstration
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.movement.promp import _Weights, basis_functions

X = GRID[:, np.newaxis]


def fit(model, demos):
    inputs, y, groups = stacked(demos)
    return model.fit(inputs, y, groups=groups)


@pytest.fixture(scope="module")
def promp():
    return fit(ProMPBaseline(n_basis=10, overlap=0.7, ridge=0.0, shrinkage=0.0), movements(30))


def published(promp):
    """The same law in movement_primitives, which has the outputs first."""
    d, n_basis = promp.n_outputs_, promp.n_basis_
    covariance = promp.weight_covariance_.reshape(n_basis, d, n_basis, d).transpose(1, 0, 3, 2)
    mean = promp.weight_mean_.T.ravel()
    return ProMP(d, n_basis).from_weight_distribution(mean, covariance.reshape(d * n_basis, -1))


def published_weights():
    """Weights (30, 10, 2) of each of the movements."""
    return np.stack([ProMP(2, 10).weights(GRID, demo).reshape(2, 10).T for demo in movements(30)])


def test_promp_is_the_published_one(promp):
    weights = published_weights()
    np.testing.assert_allclose(promp.weight_mean_, np.mean(weights, axis=0), atol=1e-6)
    flat = np.reshape(weights, (30, -1))
    np.testing.assert_allclose(promp.weight_covariance_, np.cov(flat.T), atol=1e-6)
    mean, covariance = promp.predict_joint(X)
    other = published(promp)
    np.testing.assert_allclose(mean, other.mean_trajectory(GRID), atol=1e-6)
    noise = np.kron(np.eye(len(GRID)), np.diag(promp.noise_scale_**2))
    own = covariance.reshape(noise.shape) - noise
    expected = other.cov_trajectory(GRID).reshape(2, len(GRID), 2, len(GRID)).transpose(1, 0, 3, 2)
    np.testing.assert_allclose(own, expected.reshape(noise.shape), atol=1e-6)


def test_promp_is_shrunk_towards_the_covariance_of_the_outputs_over_all_bases():
    model = fit(ProMPBaseline(n_basis=10, overlap=0.7, ridge=0.0, shrinkage=1.0), movements(30))
    outputs = np.mean([np.cov(values.T) for values in published_weights().transpose(1, 0, 2)], axis=0)
    smooth = RBF(model.reach_)(np.arange(10.0)[:, np.newaxis])
    np.testing.assert_allclose(model.weight_covariance_, np.kron(smooth, outputs), atol=1e-6)


def test_promp_judges_demonstrations_by_the_law_of_the_others():
    demos = movements(5)
    weights = _Weights([Demonstration(GRID, demo) for demo in demos], 8, 0.7, 1e-6)
    bases, noise = np.kron(basis_functions(GRID, 8, 0.7), np.eye(2)), np.tile(weights.noise_scale**2, 30)
    expected = 0.0
    for own, demo in enumerate(demos):
        others = np.delete(weights.values, own, axis=0)
        covariance = bases @ weights.covariance(others, 2.0, 0.3) @ bases.T + np.diag(noise)
        mean = bases @ others.reshape(4, -1).mean(axis=0)
        expected += multivariate_normal(mean, covariance).logpdf(demo.ravel())
    assert weights.left_out(2.0, 0.3) == pytest.approx(expected, rel=1e-6)


def test_promp_is_conditioned_as_the_published_one(promp):
    value, noise = np.array([0.5, 0.3]), np.diag(promp.noise_scale_**2)
    other = published(promp).condition_position(value, y_cov=noise + 0.1**2 * np.eye(2), t=GRID[12])
    own = promp.condition(GRID[12:13, np.newaxis], [value], noise_scale=0.1)
    # At the step itself ours has its own noise too, which was observed with it.
    beside = np.arange(len(GRID)) != 12
    np.testing.assert_allclose(own.predict(X)[beside], other.mean_trajectory(GRID)[beside], atol=1e-6)
    variance = np.diagonal(own.predict_cov(X), axis1=1, axis2=2) - promp.noise_scale_**2
    np.testing.assert_allclose(variance[beside], other.var_trajectory(GRID)[beside], atol=1e-6)


def test_promp_reaches_what_it_should_on_letters(recordings):
    demonstrations = load_demonstrations(recordings / "letter_G.npz").align(n=50)
    y = demonstrations.to_array()
    y = (y - y.mean((0, 1))) / y.std((0, 1))
    grid = np.linspace(0.0, 1.0, 50)
    scores = []
    for left_out in range(4):
        inputs, targets, groups = stacked(np.delete(y, left_out, axis=0), grid)
        model = ProMPBaseline().fit(inputs, targets, groups=groups)
        scores.append(model.score_demonstrations(grid[:, np.newaxis], y[left_out])[0])
    assert np.mean(scores) > 150.0


def standardized_reference(model, time):
    """Mean and covariance of the reference of ``movements(8)``, standardized, and their mean and deviation."""
    y = movements(8).reshape(-1, 2)
    shift, scale = y.mean(axis=0), y.std(axis=0)
    mean, covariance = model.regressor_.predict(time, return_cov=True)
    return (mean - shift) / scale, covariance / np.outer(scale, scale), shift, scale


def test_kmp_has_the_mean_of_the_published_one():
    model = fit(KMPBaseline(n_reference=40, length_scale=0.2, lambda_mean=2.0), movements(8))
    time = np.linspace(0.0, 1.0, 40)[:, np.newaxis]
    mean, covariance, shift, scale = standardized_reference(model, time)
    rate = 0.5 / 0.2**2  # k = exp(-l r^2)
    other = LC_NS_KMP(output_dim=2, horizon=40, lambda_=2.0, l=rate)
    expected = shift + scale * other.predict(time, time, mean, covariance)
    np.testing.assert_allclose(model.predict(time), expected, atol=1e-6)


def test_kmp_has_the_covariance_of_its_equation():
    model = fit(KMPBaseline(n_reference=25, nugget=1e-6), movements(8))
    reference = np.linspace(0.0, 1.0, 25)
    _, covariances, _, scale = standardized_reference(model, reference[:, np.newaxis])

    def kernel(a, b):
        return np.kron(np.exp(-0.5 * np.square((a[:, np.newaxis] - b) / 0.144)), np.eye(2))

    noise = np.zeros((50, 50))
    for i, block in enumerate(covariances):
        noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    at = np.array([0.1, 0.52])
    cross = kernel(at, reference)
    expected = kernel(at, at) - cross @ np.linalg.solve(kernel(reference, reference) + 60.0 * noise, cross.T)
    own = model.predict_joint(at[:, np.newaxis])[1].reshape(4, 4) / np.outer(*2 * [np.tile(scale, 2)])
    np.testing.assert_allclose(own, 25.0 / 60.0 * expected, atol=1e-5)


def test_kmp_passes_its_via_points_and_keeps_the_outputs_that_are_not_given():
    model = fit(KMPBaseline(), movements(8))
    known = model.condition([[0.5]], [[0.4, np.nan]])
    mean, before = known.predict([[0.5]])[0], model.predict([[0.5]])[0]
    assert mean[0] == pytest.approx(0.4, abs=0.02)
    assert mean[1] == pytest.approx(before[1], abs=0.05)
    np.testing.assert_allclose(known.predict([[0.0]]), model.predict([[0.0]]), atol=0.05)
    again = known.condition([[0.8]], [[0.1, 0.1]])
    np.testing.assert_allclose(again.predict([[0.8]]), [[0.1, 0.1]], atol=0.03)
    # The nearest time of the reference moved; the model that was conditioned is as it was.
    np.testing.assert_array_equal(model.predict([[0.5]])[0], before)


def test_kmp_keeps_all_that_is_known_where_the_reference_has_one_time():
    model = fit(KMPBaseline(), movements(8))
    near = np.array([[0.502], [0.503]])
    value = model.predict(near) + np.array([[0.02], [0.03]])
    np.testing.assert_allclose(model.condition(near, value).predict(near), value, atol=0.004)
    # What is known exactly is not forgotten for a later, worthless observation.
    known = model.condition(near[:1], value[:1])
    worthless = known.condition(near[:1], [[0.9, 0.9]], noise_scale=10.0)
    np.testing.assert_allclose(worthless.predict(X), known.predict(X), atol=1e-3)
    # Of one output nothing is learned of the other, however often it is seen.
    many = np.linspace(0.4, 0.6, 100)[:, np.newaxis]
    one = model.condition(many, np.column_stack([model.predict(many)[:, 0], np.full(100, np.nan)]))
    np.testing.assert_allclose(one.predict_cov([[0.5]])[0, 1, 1], model.predict_cov([[0.5]])[0, 1, 1], rtol=0.05)
    # Nor is the reference's end for a point beyond it.
    end, beyond = np.array([[1.0]]), model.condition([[5.0]], [[0.0, 0.0]])
    np.testing.assert_allclose(beyond.predict_cov(end), model.predict_cov(end), rtol=1e-6)


@pytest.mark.parametrize("make", [ProMPBaseline, KMPBaseline])
@pytest.mark.parametrize(("unit", "origin"), [(1e3, 0.0), (1e-6, 0.0), (1.0, 100.0), ([1e3, 1e-2], [0.0, -70.0])])
def test_units_and_origins_of_outputs_decide_nothing(make, unit, origin):
    demos = movements(6)
    # Half of the recordings end early: what is not seen of them is not at the origin.
    inputs, y, groups = stacked(demos)
    seen = (groups % 2 == 0) | (inputs[:, 0] < 0.6)
    unit, origin = np.broadcast_to(unit, 2), np.asarray(origin)
    model, other = (
        make().fit(inputs[seen], part[seen], groups=groups[seen]).condition([[0.5]], via, noise_scale=noise)
        for part, via, noise in (
            (y, [[0.4, np.nan]], 0.1),
            (origin + unit * y, origin + [[0.4, np.nan]] * unit, 0.1 * unit),
        )
    )
    (mean, covariance), (own, own_covariance) = (each.predict_joint(X) for each in (model, other))
    np.testing.assert_allclose((own - origin) / unit, mean, rtol=0, atol=1e-9)
    own_covariance = own_covariance / unit[:, np.newaxis, np.newaxis] / unit
    np.testing.assert_allclose(own_covariance, covariance, rtol=0, atol=1e-9)


@pytest.mark.parametrize("shown", [GRID < 0.6, np.isin(GRID, GRID[[0, 15, -1]])])
def test_promp_takes_what_a_recording_that_ends_early_or_has_few_samples_does_not_show_from_the_others(shown):
    once = basis_functions(GRID, 8, 0.7) @ np.random.default_rng(0).normal(size=(8, 2))
    inputs, y, groups = stacked(np.stack([once] * 6))
    seen = (groups % 3 > 0) | np.tile(shown, 6)
    model, partial = ProMPBaseline(n_basis=8, overlap=0.7), ProMPBaseline(n_basis=8, overlap=0.7)
    with pytest.warns(DataRankWarning, match="The demonstrations are identical: their covariance is zero"):
        model.fit(inputs, y, groups=groups)
    once_more = ProMPBaseline(n_basis=8, overlap=0.7, ridge=0.0)
    with pytest.warns(DataRankWarning):
        once_more.fit(inputs[seen], y[seen], groups=groups[seen])
    partial.fit(inputs[seen], y[seen], groups=groups[seen])
    for each in (model, partial, once_more):
        np.testing.assert_allclose(each.predict(X), once, atol=1e-3)


def test_recordings_of_few_samples_say_little_of_promps_noise():
    rng = np.random.default_rng(0)
    smooth = basis_functions(GRID, 12, 0.7) @ rng.normal(size=(9, 12, 2))
    inputs, y, groups = stacked(smooth + 0.01 * rng.normal(size=smooth.shape))
    seen = (groups > 3) | np.isin(inputs[:, 0], GRID[[0, 15, -1]])
    model = ProMPBaseline(n_basis=12, overlap=0.7).fit(inputs[seen], y[seen], groups=groups[seen])
    assert (np.abs(np.log(model.noise_scale_ / 0.01)) < 0.3).all()


def test_scores_pass_through_a_pipeline_with_the_groups():
    inputs, y, groups = stacked(movements(6))
    with sklearn.config_context(enable_metadata_routing=True):
        model = ProMPBaseline(n_basis=8).set_fit_request(groups=True).set_score_request(groups=True)
        options = {"params": {"groups": groups}, "cv": GroupKFold(3), "error_score": "raise"}
        alone, piped = (
            cross_val_score(each, inputs, y, **options) for each in (model, make_pipeline(MinMaxScaler(), model))
        )
    np.testing.assert_allclose(piped, alone, rtol=1e-9)
    fitted = fit(model, movements(6))
    with pytest.raises(ValueError, match=r"sample_weight is .*, must be None: weigh what score_demonstrations returns"):
        fitted.score(inputs, y, groups=groups, sample_weight=np.ones(len(y)))


def test_times_are_told_where_a_lost_sample_made_phases_of_them(recwarn):
    demos, seconds = movements(6), 2.0 * GRID
    over_time = ProMPBaseline(n_basis=8).fit(Demonstrations(seconds, demos))
    lost = Demonstrations([seconds] * 5 + [seconds[:-1]], [*demos[:5], demos[5, :-1]])
    model = ProMPBaseline(n_basis=8).fit(lost)
    at, value = np.array([[1.5]]), np.array([[0.4, 0.4]])
    over_time.condition(at, value).sample_demonstrations(2.0 * X)
    assert model.score(lost) == pytest.approx(over_time.score(Demonstrations(seconds, demos)), rel=0.1)
    model.condition(at / 2.0, value).sample_demonstrations(X)
    model.score(X * (1.0 + 1e-12), demos[0])
    assert not recwarn.list
    for use in (
        lambda: model.predict(at),
        lambda: model.predict_cov(-at),
        lambda: model.condition(at, value),
        lambda: model.score(2.0 * X, demos[0]),
        lambda: model.score_demonstrations(2.0 * X, demos[0]),
        lambda: model.log_likelihood(at, value),
    ):
        with pytest.warns(UserWarning, match="times differ, so X is a phase from 0, the start, to 1, the end: divide"):
            use()


@pytest.mark.parametrize("make", [ProMPBaseline, KMPBaseline])
@pytest.mark.parametrize("value", [0.5, -1e9])
def test_a_constant_output_is_predicted_beside_others(make, value):
    demos = movements(6)
    model = fit(make(), np.concatenate([demos, np.full((6, 30, 1), value)], axis=2))
    mean, covariance = model.predict_joint(X)
    np.testing.assert_allclose(mean[:, 2], value, rtol=1e-9)
    assert model.score(X, np.column_stack([demos[0], np.full(30, value)])) > fit(make(), demos).score(X, demos[0])
    scale = np.sqrt(np.diagonal(covariance.reshape(90, 90)).reshape(30, 3))
    assert (scale[:, 2] < 0.2 * scale[:, :2].max()).all()


@pytest.mark.parametrize("make", [ProMPBaseline, KMPBaseline])
def test_baselines_have_the_methods_of_a_movement(make):
    demos = movements(6)
    model = fit(make(), demos)
    mean, covariance = model.predict_joint(X)
    flat = covariance.reshape(mean.size, -1)
    np.testing.assert_allclose(model.predict_cov(X), covariance[range(30), :, range(30)], atol=1e-10 * flat.max())
    expected = multivariate_normal(mean.ravel(), flat).logpdf(demos[0].ravel())
    assert model.score_demonstrations(X, demos[0])[0] == pytest.approx(expected, rel=1e-6)
    draws = model.sample_demonstrations(X[::6], 20_000, random_state=0).reshape(20_000, -1)
    part = covariance[::6][:, :, ::6].reshape(10, 10)
    np.testing.assert_allclose(np.cov(draws.T), part, atol=0.05 * part.max())
    assert np.isinf(model.predict_df(X)).all()
    np.testing.assert_array_equal(model.predict_uncertainty([[-0.1], [0.0], [1.0], [1.1]]).type1, [1.0, 0.0, 0.0, 1.0])
    assert clone(model).get_params() == model.get_params()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(model)).predict(X), model.predict(X))


@pytest.mark.parametrize("make", [TrajectoryRegressor, ProMPBaseline, KMPBaseline])
def test_a_fit_that_fails_leaves_what_was_fitted(make):
    model, (inputs, y, groups) = fit(make(), movements(6)), stacked(movements(6))
    before = model.condition([[0.5]], [[0.3, 0.3]]).predict(X)
    with pytest.raises(ValueError, match="groups has one demonstration"):
        model.fit(inputs[:30], np.repeat(y[:30], 2, axis=1), groups=groups[:30])
    with pytest.raises(
        ValueError, match=r"X has 6 demonstrations, of which no two overlap from 0 to 303: .* its own start"
    ):
        model.fit(inputs + 60.4 * groups[:, np.newaxis], y, groups=groups)  # stamps of a clock
    np.testing.assert_array_equal(model.condition([[0.5]], [[0.3, 0.3]]).predict(X), before)
    assert not make()._known.time.size
    for method, arguments in [("score", (inputs, y)), ("predict", (X,)), ("predict_uncertainty", (X,))]:
        with pytest.raises(NotFittedError):
            getattr(make(), method)(*arguments)


@pytest.mark.parametrize("make", [TrajectoryRegressor, ProMPBaseline, KMPBaseline])
def test_demonstrations_may_show_parts_of_a_movement(make):
    inputs, y, groups = stacked(movements(9))
    shown = np.abs(inputs[:, 0] - np.linspace(0.2, 0.8, 9)[groups]) <= 0.2
    model = make().fit(inputs[shown], y[shown], groups=groups[shown])
    assert np.isfinite(model.predict(X)).all()


@pytest.mark.parametrize("make", [TrajectoryRegressor, ProMPBaseline])
def test_a_row_of_which_an_output_is_known_has_no_density_whatever_rounding_leaves(make):
    model = fit(make(), movements(6))
    for at in np.linspace(0.01, 0.99, 15):
        known = model.condition([[at]], [[0.9, np.nan]])
        for score in (known.log_likelihood, known.score_demonstrations):
            with pytest.raises(ValueError, match="known without noise"):
                score([[at]], [[0.9, 0.4]])


@pytest.mark.parametrize("make", [TrajectoryRegressor, ProMPBaseline])
def test_single_rows_are_drawn_and_scored_by_their_law(make):
    model = fit(make(), movements(6)).condition([[0.3]], [[0.5, 0.5]])
    at, y = np.array([[0.6]]), np.array([[0.2, 0.7]])
    mean, covariance = (part[0] for part in model.predict(at, return_cov=True))
    df = model.predict_df(at)[0]
    law = multivariate_t(mean, covariance * (df - 2.0) / df, df) if np.isfinite(df) else None
    law = law or multivariate_normal(mean, covariance)
    assert model.log_likelihood(at, y)[0] == pytest.approx(law.logpdf(y[0]), rel=1e-9)
    drawn = model.sample_y(at, 100_000, random_state=0)[0]
    np.testing.assert_allclose(np.cov(drawn), covariance, rtol=0.1, atol=0.05 * covariance.max())
    edges = [0.001, 0.01, 0.99, 0.999]
    own = np.quantile(law.rvs(100_000, random_state=1)[:, 0], edges)
    np.testing.assert_allclose(np.quantile(drawn[0], edges), own, atol=0.3 * covariance[0, 0] ** 0.5)


@pytest.mark.parametrize("make", [TrajectoryRegressor, ProMPBaseline, KMPBaseline])
def test_no_rows_have_a_law_and_draws_too(make):
    model, none = fit(make(), movements(6)), np.empty((0, 1))
    for law in (model, model.condition([[0.5]], [[0.1, np.nan]])):
        assert [part.shape for part in law.predict_joint(none)] == [(0, 2), (0, 2, 0, 2)]
        assert law.sample_demonstrations(none, 3).shape == (3, 0, 2)


def test_promp_is_conditioned_by_the_normal_formulas():
    model = fit(ProMPBaseline(), movements(6))
    at = np.array([[0.0], [0.33], [0.71]])
    mean, covariance = model.predict_joint(at)
    expected = gaussian_conditional(mean.ravel(), covariance.reshape(6, 6), [2, 3], np.array([0.1, 0.9]), [0.0, 0.0])
    known = model.condition(at[1:2], [[0.1, 0.9]])
    np.testing.assert_allclose(known.predict_joint(at)[0].ravel(), expected[0], atol=1e-9)
    np.testing.assert_allclose(known.predict_joint(at)[1].reshape(6, 6), expected[1], atol=1e-9)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (ProMPBaseline(n_basis=1), "n_basis is 1, must be an integer of at least 2"),
        (ProMPBaseline(overlap=1.0), "overlap is 1.0, must be a finite number above 0 and below 1"),
        (ProMPBaseline(shrinkage=-0.1), "shrinkage is -0.1, must be a finite number of at least 0"),
        (KMPBaseline(lambda_cov=0.0), "lambda_cov is 0.0, must be a finite number above 0"),
        (KMPBaseline("HGP"), "regressor is 'HGP', must be a covariance regressor or None"),
    ],
)
def test_parameters_are_checked(model, message):
    with pytest.raises(ValueError, match=message):
        fit(model, movements())
