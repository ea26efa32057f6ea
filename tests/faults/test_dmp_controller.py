"""Demonstrations, parameters and queries that the controller must survive, or refuse with a message that says what.

Numbers in the names are those of the list of faults that the project keeps.
"""

import warnings
from functools import cache

import numpy as np
import pandas as pd
import pytest
import torch
from sklearn.exceptions import NotFittedError

import torch_pbd.files.memory
from torch_pbd import CholeskyCovRegressor, Demonstrations, DMPController
from torch_pbd.control import AdmittancePlant, StiffnessLaw
from torch_pbd.data import make_tunnel_demonstrations
from torch_pbd.exceptions import DataRankWarning

QUERIES = ["predict", "predict_cov", "predict_stiffness", "predict_damping"]


def new(**parameters):
    return DMPController(CholeskyCovRegressor(max_iter=30), n_steps=20).set_params(**parameters)


@cache
def recorded():
    return make_tunnel_demonstrations(4, 2.0, 50.0, random_state=0)


@cache
def controller():
    return new().fit(recorded())


def stacked():
    return recorded().stack()


def told(fit):
    """What fit() warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit()
    return caught


def test_1_one_demonstration_is_refused():
    X, y, _ = recorded()[:1].stack()
    with pytest.raises(ValueError, match=r"DMPController needs >= 2 demonstrations, got 1.*Record more"):
        new().fit(X, y)


def test_2_fewer_demonstrations_than_outputs_are_told_once():
    X, y, groups = recorded()[:2].stack()
    caught = told(lambda: new().fit(X, y, groups=groups))
    assert [w.category for w in caught if w.category is DataRankWarning] == [DataRankWarning]


@pytest.mark.parametrize("value", [0.0, 0.5, 1e6])
def test_3_4_what_does_not_move_or_vary_is_held_stiffly_and_told(value):
    X, y, groups = stacked()
    for positions in (np.full_like(y, value), value + np.tile(y[: len(y) // 4], (4, 1))):
        model = new()
        caught = told(lambda model=model, positions=positions: model.fit(X, positions, groups=groups))
        assert any("covariances do not vary" in str(warning.message) for warning in caught)
        stiffness = model.predict_stiffness([[0.0], [1.0], [2.0]])
        np.testing.assert_allclose(stiffness, np.broadcast_to(1000.0 * np.eye(2), (3, 2, 2)), rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("offset", [1e6, 1e9])
def test_15_offsets_change_no_stiffness(offset):
    X, y, groups = stacked()
    expected = controller().predict_stiffness(X[:100:10])
    moved = new().fit(X, y + offset, groups=groups).predict_stiffness(X[:100:10])
    # What is left of 1e-16 of the offset beside a standard deviation of 3 mm.
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-6 * offset * 1e-3 + 1.0)


def test_15_unix_time_is_as_time_from_zero():
    X, y, groups = stacked()
    later = new().fit(X + 1.7e9, y, groups=groups)
    expected = controller().predict_stiffness(X[:100:10])
    np.testing.assert_allclose(later.predict_stiffness(X[:100:10] + 1.7e9), expected, rtol=1e-4, atol=0.5)


BAD_DATA = [
    (lambda X, y, g: (X, None, g), ValueError, r"y is None: give Demonstrations, or times X"),
    (lambda X, y, g: (None, y, g), ValueError, "Expected 2D array"),
    (lambda X, y, g: (X, y, None), ValueError, r"X does not increase at row 101: .* give groups"),
    (lambda X, y, g: (X[:, 0], y, g), ValueError, "Expected 2D array, got 1D"),
    (lambda X, y, g: (np.hstack([X, X]), y, g), ValueError, r"X has 2 columns, must have 1: the time"),
    (lambda X, y, g: (X, y[:5], g), ValueError, "inconsistent numbers of samples"),
    (lambda X, y, g: (X, y.T, g), ValueError, "inconsistent numbers of samples"),
    (lambda X, y, g: (X, y[:, :0], g), ValueError, r"0 feature\(s\)"),
    (lambda X, y, g: (X[:0], y[:0], g[:0]), ValueError, r"0 sample\(s\)"),
    (
        lambda X, y, g: (X[::-1], y[::-1], g[::-1]),
        ValueError,
        r"times\[0\] must increase strictly, but sample 1",
    ),
    (lambda X, y, g: (np.zeros_like(X), y, g), ValueError, "must increase strictly"),
    (lambda X, y, g: (X, y, g[:5]), ValueError, r"groups has shape \(5,\), must have shape \(404,\)"),
    (
        lambda X, y, g: (X, y, np.where(g == 3, np.nan, g)),
        ValueError,
        "groups has a label that is not finite",
    ),
    (lambda X, y, g: (X, y, np.where(g == 3, None, g)), ValueError, "groups has no label at index 303"),
    (lambda X, y, g: (X, y, ["1" if i % 2 else 1 for i in g]), ValueError, "groups has labels of several types"),
    (lambda X, y, g: (X.astype(str), y, g), ValueError, "X holds text"),
    (lambda X, y, g: (X, y.astype(str), g), ValueError, "y holds text"),
    (lambda X, y, g: (X, y + 1j, g), ValueError, "Complex data not supported: y"),
    (lambda X, y, g: (X, np.ma.masked_array(y, y > 0.1), g), ValueError, "y has masked entries"),
    (lambda X, y, g: (X.astype("datetime64[s]"), y, g), ValueError, "X holds dates or durations"),
    (
        lambda X, y, g: (X, np.where(y > 0.5, np.nan, y), g),
        ValueError,
        r"y\[\d+, \d\] is nan, must be finite",
    ),
    (lambda X, y, g: (np.where(X > 1.0, np.inf, X), y, g), ValueError, r"X\[51, 0\] is inf, must be finite"),
    (lambda X, y, g: (X, y * 1e200, g), ValueError, "the largest value of y.* as its square is"),
    (lambda X, y, g: (X * 1e-300, y, g), ValueError, "the largest value of X.* as its square is"),
    (
        lambda X, y, g: (X, (y + 2000.0).astype(np.float16), g),
        ValueError,
        r"the resolution of float16 in y\[1\]",
    ),
    (lambda X, y, g: ((X + 1.7e9).astype(np.float32), y, g), ValueError, "must increase strictly"),
    (lambda X, y, g: (recorded(), y, None), ValueError, "X is Demonstrations.*give neither y nor groups"),
    (lambda X, y, g: (recorded(), None, g), ValueError, "X is Demonstrations.*give neither y nor groups"),
    (lambda X, y, g: ([d.position for d in recorded()], None, None), ValueError, "y is None: give Demonstrations"),
    (lambda X, y, g: ({}, y, g), TypeError, "X holds what is no number"),
]


@pytest.mark.parametrize(("broken", "error", "message"), BAD_DATA, ids=[message for _, _, message in BAD_DATA])
def test_6_to_17_data_that_cannot_be_used_are_refused(broken, error, message):
    X, y, groups = broken(*stacked())
    with pytest.raises(error, match=message):
        new().fit(X, y, groups=groups)


def test_12_recordings_that_are_too_short_are_refused_with_their_number():
    times, positions = [*recorded().times, np.arange(3.0)], [*recorded().positions, np.zeros((3, 2))]
    with pytest.raises(ValueError, match=r"demonstration 4 has 3 samples, needs at least 5 .*or cutoff=None for 3"):
        new().fit(Demonstrations(times, positions, units="m"))


@pytest.mark.parametrize("form", [torch.tensor, pd.DataFrame, np.asfortranarray, lambda a: a.tolist()])
def test_18_other_forms_of_the_same_numbers_are_the_same_controller(form):
    X, y, groups = stacked()
    kept = X.copy(), y.copy()
    model = new().fit(form(X), form(y), groups=groups)
    np.testing.assert_array_equal(model.predict_stiffness(form(X[:5])), controller().predict_stiffness(X[:5]))
    np.testing.assert_array_equal(X, kept[0])
    np.testing.assert_array_equal(y, kept[1])
    needing = torch.tensor(X, requires_grad=True)
    np.testing.assert_array_equal(model.predict(needing[:5]), controller().predict(X[:5]))


def test_16_float32_is_fitted_without_a_word_of_overflow():
    X, y, groups = stacked()
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        new().fit(X.astype(np.float32), y.astype(np.float32), groups=groups)


def test_20_a_movement_of_many_ticks_is_refused_with_its_memory(monkeypatch):
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 2**27)
    with pytest.raises(ValueError, match=r"a schedule of 2000001 ticks of 2 axes needs about .* GiB.*Lower rate"):
        controller().schedule(1e6)
    with pytest.raises(ValueError, match=r"a schedule of 2e\+300 ticks .* needs about .* GiB.*Lower rate"):
        controller().schedule(1e300)


@pytest.mark.parametrize("n_steps", [10**5, 10**9, np.int64(10**12)])
def test_20_a_movement_of_many_steps_is_refused_with_its_memory(n_steps, monkeypatch):
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 2**34)
    with pytest.raises(ValueError, match=rf"n_steps={n_steps} of 4 demonstrations of 2 axes needs about .* GiB"):
        new(n_steps=n_steps).fit(recorded())
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 2**26)
    with pytest.raises(ValueError, match=rf"n_steps={10 * n_steps} of 4 .* GiB of memory.*Lower n_steps"):
        controller().smooth(recorded(), 10 * n_steps)


@pytest.mark.parametrize("far", [1e6, -1e6, 1e300, -1e300])
@pytest.mark.parametrize("method", QUERIES)
def test_24_far_away_everything_is_finite(method, far):
    assert np.isfinite(getattr(controller(), method)([[far]])).all()


def test_24_where_nothing_is_known_it_is_compliant_or_the_prior_or_an_error():
    far = [[1e6]]
    np.testing.assert_allclose(controller().predict_stiffness(far)[0], 50.0 * np.eye(2), atol=1e-6)
    with pytest.raises(ValueError, match=r"There are no data at time 1e\+06 s: the Type I uncertainty is 1\.00"):
        new(on_unknown="raise").fit(recorded()).predict_stiffness(far)


@pytest.mark.parametrize("method", QUERIES)
def test_25_misuse_of_queries_is_told(method):
    with pytest.raises(NotFittedError, match="not fitted yet"):
        getattr(new(), method)([[0.0]])
    for query, error, message in [
        ([0.0], ValueError, "Expected 2D array"),
        ([[0.0, 1.0]], ValueError, "X has 2 features, but DMPController is expecting 1"),
        ([[np.nan]], ValueError, r"X\[0, 0\] is nan, must be finite"),
        ([[np.inf]], ValueError, r"X\[0, 0\] is inf, must be finite"),
        ([["1"]], ValueError, "X holds text"),
        ([[1j]], ValueError, "Complex data not supported: X"),
        (None, ValueError, "Expected 2D array"),
        ([[{}]], TypeError, "X holds what is no number"),
        (np.ma.masked_array([[1.0]], [[True]]), ValueError, "X has masked entries"),
        (np.array([["2026-01-01"]], dtype="datetime64[s]"), ValueError, "X holds dates"),
    ]:
        with pytest.raises(error, match=message):
            getattr(controller(), method)(query)


@pytest.mark.parametrize("method", ["schedule", "simulate", "smooth"])
def test_25_a_controller_that_is_not_fitted_says_so(method):
    with pytest.raises(NotFittedError, match="not fitted yet"):
        getattr(new(), method)(*([recorded()] if method == "smooth" else []))


def test_25_a_fit_that_fails_leaves_no_mixture_of_two():
    model = new().fit(recorded())
    with pytest.raises(ValueError, match="alpha is -1"):
        model.set_params(alpha=-1.0).fit(recorded())
    with pytest.raises(NotFittedError):
        model.predict([[0.0]])


def test_26_no_times_are_none():
    none = np.empty((0, 1))
    shapes = [getattr(controller(), method)(none).shape for method in QUERIES]
    assert shapes == [(0, 2), (0, 2, 2), (0, 2, 2), (0, 2, 2)]


BAD_VALUES = ["1e-3", np.nan, np.inf, -1.0, 0.0, True, [1.0], 1j, 10**400]
BAD_PARAMETERS = [
    (name, value) for name in ("alpha", "beta", "gamma", "tau", "duration", "mass", "cutoff") for value in BAD_VALUES
]
BAD_PARAMETERS += [(name, None) for name in ("alpha", "gamma", "tau", "n_steps", "damping_ratio")]
BAD_PARAMETERS += [(name, "x") for name in ("gate", "phase_input", "variability", "goal", "on_unknown")]
BAD_PARAMETERS += [("stiffness_law", "x"), ("stiffness_law", StiffnessLaw)]
BAD_PARAMETERS += [("n_steps", value) for value in (4, 2.5, True, "20", 10**400)]
BAD_PARAMETERS += [("damping_ratio", value) for value in (-0.1, np.nan, "critical", True, 1e300)]
BAD_PARAMETERS += [("covariance", value) for value in ("cholesky", 1.0, CholeskyCovRegressor, [], StiffnessLaw())]
BAD_PARAMETERS += [(name, value) for name in ("alpha", "tau") for value in (1e-300, 1e300)]
BAD_PARAMETERS += [("cutoff", 1e-300), ("cutoff", 1e300), ("duration", 1e300), ("duration", 1e-300), ("beta", 1e300)]


@pytest.mark.parametrize(("name", "value"), BAD_PARAMETERS, ids=lambda value: repr(value)[:20])
def test_parameters_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"{name} (== |is)"):
        new(**{name: value}).fit(recorded())


@pytest.mark.parametrize(("phase_input", "gamma"), [("s", 1e300), ("s", 1e-300), ("log_s", 1e300), ("s", 50.0)])
def test_a_phase_whose_times_cannot_be_told_apart_is_refused(phase_input, gamma):
    with pytest.raises(
        ValueError, match=r"gamma is .* time constants in a movement of 2 s, must be 1e-06 to .*phase_input="
    ):
        new(phase_input=phase_input, gamma=gamma).fit(recorded())


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64])
def test_numbers_of_numpy_are_numbers(kind):
    model = new(alpha=kind(25), tau=kind(1), mass=kind(1), cutoff=kind(20), duration=kind(2)).fit(recorded())
    assert model.schedule(50.0).provenance["cutoff"] == 20


BAD_CALLS = [
    ("simulate", {"force": "x"}, "force holds text"),
    ("simulate", {"force": 5.0}, r"force has shape \(\), must have shape \(201, 2\)"),
    ("simulate", {"force": np.zeros((2, 201))}, r"force has shape \(2, 201\)"),
    ("simulate", {"force": np.full((201, 2), np.nan)}, r"force\[0, 0\] is nan, must be finite"),
    ("simulate", {"force": np.zeros((201, 2)) + 1j}, "Complex data not supported: force"),
    ("simulate", {"force": np.ma.masked_all((201, 2))}, "force has masked entries"),
    ("simulate", {"plant": "x"}, "plant is 'x', must be an AdmittancePlant"),
    ("simulate", {"plant": AdmittancePlant}, "must be an AdmittancePlant or None"),
    ("simulate", {"random_state": -1}, "random_state is -1, must be None"),
    ("schedule", {"goal": 1.0}, r"goal has shape \(\), must have shape \(2,\)"),
    ("schedule", {"goal": np.zeros((3, 2))}, r"goal has shape \(3, 2\)"),
    ("schedule", {"goal": ["1", "2"]}, "goal holds text"),
    ("schedule", {"start": np.zeros((201, 2))}, r"start has shape \(201, 2\), must have shape \(2,\)"),
    ("schedule", {"start": [np.inf, 0.0]}, r"start\[0\] is inf, must be finite"),
    ("schedule", {"settle": -1.0}, "settle is -1.0 s, must be a finite number of at least 0"),
    ("schedule", {"settle": np.nan}, "settle is nan s, must be a finite number"),
    ("smooth", {"demonstrations": np.zeros((4, 5, 2))}, "demonstrations is of type ndarray, must be a Demonstrations"),
    ("smooth", {"demonstrations": recorded(), "n_steps": 0}, "n_steps is 0, must be an integer of at least 2"),
    (
        "varying",
        {"movements": "x"},
        r"movements is .x., must be a Movements: give what smooth\(demonstrations\) returns",
    ),
]


@pytest.mark.parametrize(("method", "given", "message"), BAD_CALLS, ids=[message for _, _, message in BAD_CALLS])
def test_arguments_that_cannot_be_used_are_refused_by_name(method, given, message):
    rate = {"rate": 100.0} if method in ("simulate", "schedule") else {}
    with pytest.raises(ValueError, match=message):
        getattr(controller(), method)(**rate, **given)


@pytest.mark.parametrize("rate", ["100", None, 0.0, -1.0, np.nan, np.inf, True, 1e-3, 10**400])
def test_rates_that_are_none_are_refused(rate):
    for method in ("schedule", "simulate"):
        with pytest.raises(ValueError, match="rate is "):
            getattr(controller(), method)(rate=rate)
