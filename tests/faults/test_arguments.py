"""What no function takes for numbers: each door refuses it by the name of the argument."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from estimators.zoo import DEFAULTS, demonstrations, fitted, new

from torch_pbd import Demonstrations, plotting
from torch_pbd.control import (
    DMP,
    AdmittancePlant,
    ForceSensor,
    RealTimeAdmittance,
    Schedule,
    StiffnessLaw,
    Tunnel,
    certify,
    damping_from_stiffness,
    simulate_many,
)
from torch_pbd.data import check_unimodal, make_paper_simulation, make_tunnel_demonstrations, paper_mean
from torch_pbd.metrics import (
    covariance_mse,
    gaussian_kl,
    log_likelihood_scorer,
    mahalanobis_coverage,
    negative_log_likelihood,
    relative_frobenius_error,
)

N, D = 20, 2
TIME = np.arange(N) / 100.0
STILL = np.zeros((N, D))
GAIN, DAMPING = np.tile(200.0 * np.eye(D), (N, 1, 1)), np.tile(20.0 * np.eye(D), (N, 1, 1))
ROWS = {"time": TIME, "position": STILL, "velocity": STILL, "stiffness": GAIN, "damping": DAMPING}
SCHEDULE = Schedule(**ROWS, covariance=1e-4 * GAIN, type1=np.zeros(N))
LAW = StiffnessLaw(sigma_low=0.01, sigma_high=0.03, bounds="sigma")


def plant(**changed):
    given = {
        "position_desired": STILL,
        "velocity_desired": STILL,
        "stiffness": GAIN,
        "damping": DAMPING,
        "force": STILL,
    }
    return AdmittancePlant().simulate(**{**given, "dt": 0.001, **changed})


def rollout(**changed):
    return DMP(duration=0.1).rollout(**{"forcing": STILL, "dt": 0.01, "goal": np.ones(D), **changed})


# A function of one argument, what is sound for it, and its name.
DOORS = {
    "mse": (lambda value: covariance_mse(value, GAIN), GAIN, "estimated"),
    "frobenius": (lambda value: relative_frobenius_error(GAIN, value), GAIN, "reference"),
    "kl": (lambda value: gaussian_kl(value, GAIN), GAIN, "reference"),
    "kl mean": (lambda v: gaussian_kl(GAIN, GAIN, reference_mean=v, estimated_mean=STILL), STILL, "reference_mean"),
    "nll": (lambda value: negative_log_likelihood(STILL, value, STILL), GAIN, "covariance"),
    "nll y": (lambda value: negative_log_likelihood(STILL, GAIN, value), STILL, "y"),
    "coverage": (lambda value: mahalanobis_coverage(value, GAIN, STILL), STILL, "mean"),
    "law": (LAW, GAIN, "covariance"),
    "law by quantiles": (StiffnessLaw().fitted, GAIN * np.arange(1.0, N + 1.0)[:, None, None], "covariance"),
    "damping": (damping_from_stiffness, GAIN, "stiffness"),
    "damping mass": (lambda value: damping_from_stiffness(GAIN, value), np.eye(D), "mass"),
    "plant mass": (AdmittancePlant, np.eye(D), "mass"),
    "plant position": (lambda value: plant(position_desired=value), STILL, "position_desired"),
    "plant force": (lambda value: plant(force=value), STILL, "force"),
    "plant stiffness": (lambda value: plant(stiffness=value), GAIN, "stiffness"),
    "plant start": (lambda value: plant(position0=value), STILL[0], "position0"),
    "rollout": (lambda value: rollout(forcing=value), STILL, "forcing"),
    "rollout goal": (lambda value: rollout(goal=value), np.ones(D), "goal"),
    "rollout start": (lambda value: rollout(position0=value), np.ones(D), "position0"),
    "forcing": (lambda value: DMP().forcing(STILL, value, STILL, np.ones(D)), STILL, "velocity"),
    "schedule": (lambda value: Schedule(**{**ROWS, "damping": value}, covariance=GAIN, type1=TIME), DAMPING, "damping"),
    "schedule time": (lambda value: Schedule(**{**ROWS, "time": value}, covariance=GAIN, type1=TIME), TIME, "time"),
    "schedule path": (lambda v: Schedule(**{**ROWS, "position": v}, covariance=GAIN, type1=TIME), STILL, "position"),
    "tunnel": (Tunnel().penetration, STILL, "position"),
    "positions": (lambda value: Demonstrations(TIME, value), np.stack([STILL] * 3), "positions"),
    "times": (lambda value: Demonstrations(value, np.stack([STILL] * 3)), TIME, "times"),
    "paper": (paper_mean, TIME, "xi"),
    "ellipses": (lambda value: plotting.plot_covariance_ellipses(STILL, value, plt.gca()), GAIN, "covariance"),
    "band": (lambda value: plotting.plot_std_band(TIME, value, TIME, plt.gca()), TIME, "mean"),
}


def masked(array):
    hidden = np.ma.masked_array(array.copy(), np.zeros(array.shape, dtype=bool))
    hidden.flat[0] = np.ma.masked
    return hidden


NO_NUMBERS = {
    "none": lambda array: None,
    "text": lambda array: array.astype(str),
    "one text": lambda array: "numbers",
    "complex": lambda array: array + 0j,
    "masked": masked,
    "dates": lambda array: array.astype("datetime64[s]"),
    "dict": lambda array: {"a": array},
    "generator": lambda array: (row for row in array),
    "ragged": lambda array: [[1.0], [1.0, 2.0]],
    "sparse tensor": lambda array: torch.tensor(array).to_sparse(),
    "nan": lambda array: array * np.nan,
    "empty": lambda array: array[:0],
}
PASSES = {  # what is a value there, and what it means is in the docstring
    ("tunnel", "nan"), ("sensor", "nan"), ("law", "empty"), ("damping", "empty"), ("tunnel", "empty"),
    ("paper", "empty"), ("plant force", "none"), ("plant start", "none"), ("rollout start", "none"),
    ("positions", "generator"), ("plant mass", "none"),
}  # fmt: skip


@pytest.mark.parametrize("kind", NO_NUMBERS)
@pytest.mark.parametrize("door", DOORS)
def test_what_is_no_number_is_refused_by_name_or_means_something(door, kind):
    function, sound, name = DOORS[door]
    if (door, kind) in PASSES:
        function(NO_NUMBERS[kind](sound))
        plt.close("all")
        return
    if (door, kind) == ("sensor", "none"):
        kind = "one text"
    with pytest.raises((TypeError, ValueError), match=name.replace(".", r"\.")):
        function(NO_NUMBERS[kind](sound))


@pytest.mark.parametrize("door", DOORS)
def test_what_is_a_number_is_taken_in_any_form(door):
    function, sound, _ = DOORS[door]
    for form in (np.copy, np.asfortranarray, lambda array: torch.tensor(array, requires_grad=True)):
        if "mass" in door and form is not np.copy:
            continue  # a tensor that needs gradients keeps them
        function(form(sound))
    plt.close("all")


@pytest.mark.parametrize("column", ["X", "y"])
@pytest.mark.parametrize("kind", ["one text", "masked", "dates", "dict", "generator", "ragged", "sparse tensor"])
@pytest.mark.parametrize("name", DEFAULTS)
def test_estimators_refuse_by_name_too(name, kind, column):
    X, y = demonstrations()
    data = {"X": X, "y": y}
    data[column] = NO_NUMBERS[kind](data[column])
    with pytest.raises((TypeError, ValueError), match=rf"\b{column}\b"):
        new(name).fit(**data)
    if column == "X":
        with pytest.raises((TypeError, ValueError), match=r"\bX\b"):
            fitted(name).predict_cov(data["X"])


@pytest.mark.parametrize("labels", ["short", "masked", "missing", "dates", "ragged", "mixed"])
def test_labels_of_demonstrations_that_are_none_are_refused(labels):
    X, y = demonstrations()
    groups = np.repeat(np.arange(12), 8)
    broken = {
        "short": groups[:5],
        "masked": np.ma.masked_equal(groups, 3),
        "missing": np.where(groups == 3, None, groups),
        "dates": np.full(96, "NaT", dtype="datetime64[s]"),
        "ragged": [[1], [1, 2]] * 48,
        "mixed": [1, "1"] * 48,
    }[labels]
    with pytest.raises(ValueError, match=r"^groups (has|is)"):
        new("heteroscedastic").fit(X, y, groups=broken)


def test_labels_of_any_sound_kind_are_the_same_demonstrations():
    X, y = demonstrations()
    groups = np.repeat(np.arange(12), 8)
    expected = new("heteroscedastic").fit(X, y, groups=groups).predict_cov(X[:8])
    for same in (groups.astype(str), groups.tolist(), torch.tensor(groups.astype(float), requires_grad=True)):
        np.testing.assert_array_equal(new("heteroscedastic").fit(X, y, groups=same).predict_cov(X[:8]), expected)


@pytest.mark.parametrize("name", DEFAULTS)
def test_demonstrations_in_the_place_of_arrays_are_refused_with_the_way_to_make_arrays_of_them(name):
    strokes = make_tunnel_demonstrations(random_state=0)
    remedy = r"^X is of type Demonstrations, must be an array: use X, y, groups = demonstrations\.stack\(\)\.$"
    with pytest.raises(ValueError, match=remedy):
        new(name).fit(strokes)
    with pytest.raises(ValueError, match=remedy):
        fitted(name).predict(strokes)


@pytest.mark.parametrize("weights", [[1.0], np.full(96, np.nan), -np.ones(96), np.zeros(96), ["a"] * 96])
def test_weights_that_are_none_are_refused(weights):
    with pytest.raises(ValueError, match="sample_weight"):
        fitted("cholesky").score(*demonstrations(), sample_weight=weights)


@pytest.mark.parametrize("value", [1e308, -1.0])
def test_matrices_beyond_arithmetic_or_not_positive_are_refused_and_not_made_zero(value):
    for function in (LAW, damping_from_stiffness):
        with pytest.raises(ValueError, match=r"must be finite and at most 1e\+100 in size|must be zero or more"):
            function(value * np.eye(2))


def test_variances_too_small_to_square_count_as_precise():
    with pytest.warns(UserWarning, match="do not vary"):
        stiffness = StiffnessLaw()(1e-320 * np.eye(2))
    np.testing.assert_allclose(stiffness.numpy(), 1000.0 * np.eye(2))


@pytest.mark.parametrize("level", [0.0, 1.0, 95, "0.95", None, True, [0.5], np.array([0.5, 0.9]), np.nan])
def test_levels_that_are_none_are_refused(level):
    with pytest.raises(ValueError, match=r"(?s)level is .*must be a finite number above 0 and below 1"):
        mahalanobis_coverage(STILL, GAIN, STILL, level=level)


def test_scores_of_what_is_no_model_are_refused():
    with pytest.raises(TypeError, match="estimator is None, must be a fitted covariance regressor"):
        log_likelihood_scorer(None, STILL, STILL)


def test_a_simulation_that_diverges_says_when_and_what_to_do():
    with pytest.raises(ValueError, match=r"simulation diverged, and is not finite from tick \d+ on: take a shorter dt"):
        plant(velocity_desired=STILL + 1e308)


FLAGS = [
    (lambda: StiffnessLaw(sigma_low=0.1, sigma_high=0.2, bounds="sigma", smooth="no"), "smooth"),
    (lambda: AdmittancePlant(feed_forward="no"), "feed_forward"),
    (lambda: Tunnel(virtual="no"), "virtual"),
]


@pytest.mark.parametrize(("make", "name"), FLAGS, ids=[name for _, name in FLAGS])
def test_text_is_no_truth(make, name):
    with pytest.raises((TypeError, ValueError), match=name):
        make()


CALLS = [
    (lambda: certify("schedule"), "schedule is 'schedule', must be a Schedule"),
    (lambda: RealTimeAdmittance("schedule"), "schedule is 'schedule', must be a Schedule"),
    (lambda: simulate_many("schedule"), "schedule is 'schedule', must be a Schedule"),
    (lambda: simulate_many(SCHEDULE, 10, plant="robot", duration=0.1), "plant is 'robot', must be an AdmittancePlant"),
    (lambda: simulate_many(SCHEDULE, 10, duration=0.1, random_state=-1), "random_state is -1"),
    (lambda: simulate_many(SCHEDULE, 10, duration=0.1, onset=0.1), "onset has shape .*, must have shape .2,"),
    (lambda: simulate_many(SCHEDULE, 10, duration=0.1, peak=1e300), r"peak is 1e\+300 N, must be .* at most 1e\+100"),
    (lambda: simulate_many(SCHEDULE, 10, duration=0.1, quantiles="half"), "quantiles holds text"),
    (lambda: certify(SCHEDULE, position_loop="slow"), "position_loop is 'slow', must be a PositionLoop"),
    (lambda: damping_from_stiffness(np.eye(2), np.eye(3)), r"mass has shape \(3, 3\), but stiffness has shape \(2,"),
    (lambda: damping_from_stiffness(np.ones((4, 1, 1)), np.ones((3, 1, 1))), r"mass has shape \(3, 1, 1\), but"),
    (lambda: damping_from_stiffness(GAIN, 1.0, np.eye(2)), "damping_ratio is of type ndarray, must be a finite number"),
    (lambda: damping_from_stiffness(GAIN, 1.0, torch.ones(2)), "damping_ratio is tensor"),
    (lambda: certify(SCHEDULE, mass="1"), "mass holds text"),
    (lambda: SCHEDULE.resample(1e300), r"a schedule of .* ticks of 2 axes needs about more than"),
    (lambda: SCHEDULE.retime(1e-300), "speed is 1e-300, must be a finite number of at least"),
    (lambda: AdmittancePlant(sensor=ForceSensor(noise_scale=1.0)).simulate(
        STILL, STILL, GAIN, DAMPING, dt=0.001, generator=np.random.default_rng(0)), "must be a Generator or None"),
    (lambda: DMP().forcing(STILL.T, STILL, STILL, np.ones(2)), "shapes are .*velocity.*, must be of the same"),
    (lambda: check_unimodal([1, 2]), r"demonstrations is \[1, 2\], must be a Demonstrations"),
    (lambda: make_tunnel_demonstrations(duration="10"), "duration is '10' s, must be a finite number above 0"),
    (lambda: make_tunnel_demonstrations(n_demos=10**9), "n_demos=1000000000 needs about"),
    (lambda: make_paper_simulation(random_state="seed"), "random_state is 'seed', must be None"),
    (lambda: Demonstrations(TIME, [STILL], names=3), "names is 3, must be strings"),
    (lambda: Demonstrations(TIME, [STILL]).resample(10**12), "n=1000000000000 points needs about"),
    (lambda: plotting.plot_demonstrations("file", [0], plt.gca()), "demonstrations is 'file'"),
    (lambda: plotting.plot_demonstrations(Demonstrations(TIME, [STILL]), [5], plt.gca()), r"outputs is \[5\]"),
    (lambda: plotting.plot_stiffness(None, plt.gca()), "schedule is None"),
    (lambda: plotting.plot_stiffness(SCHEDULE, None), r"ax is \[None\], must be 1 matplotlib Axes"),
    (lambda: plotting.plot_std_band(TIME, TIME, -TIME - 1.0, plt.gca()), r"std\[0\] is -1.0, must be at least zero"),
    (lambda: plotting.plot_covariance_ellipses([[0, 0]], [-np.eye(2)], plt.gca()), "must be zero or more, positive"),
    (lambda: plotting.plot_covariance_ellipses([[0] * 3], [np.eye(3)], plt.gca()), "mean has shape .1, 3., must have"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "message"), CALLS, ids=[message for _, message in CALLS])
def test_arguments_of_other_kinds_are_refused_by_name(call, message):
    with pytest.raises(ValueError, match=message):
        call()
    plt.close("all")
