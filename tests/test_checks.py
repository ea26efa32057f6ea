"""Checks of arguments: one sentence, one exception, and warnings that point at the caller."""

import warnings
from typing import Literal

import numpy as np
import pytest

from torch_pbd import (
    CholeskyCovRegressor,
    Demonstrations,
    DMPController,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    checks,
)
from torch_pbd.data import check_unimodal
from torch_pbd.exceptions import InvalidParameterError


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: checks.number(0.0, "mass", above=0.0, unit="kg"), "mass is 0.0 kg, must be a finite number above 0."),
        (
            lambda: checks.number(np.float64(2.0), "share", least=0.0, most=1.0, remedy="give a share"),
            "share is 2.0, must be a finite number of at least 0 and at most 1: give a share.",
        ),
        (lambda: checks.number("1", "tol", optional=True), "tol is '1', must be a finite number or None."),
        (lambda: checks.number(True, "tol"), "tol is True, must be a finite number."),
        (lambda: checks.number(10**400, "tol", above=0.0), "tol is of type int, must be a finite number above 0."),
        (lambda: checks.count(2.0, "n", least=2), "n is 2.0, must be an integer of at least 2."),
        (lambda: checks.count(2**60, "n"), f"n is {2**60}, must be an integer of at least 1 and at most {2**53}."),
        (lambda: checks.flag("no", "shared"), "shared is 'no', must be True or False."),
        (lambda: checks.choice("c", "kind", Literal["a", "b"]), "kind is 'c', must be one of 'a', 'b'."),
        (lambda: checks.instance([1] * 99, "X", Demonstrations), "X is of type list, must be a Demonstrations."),
        (lambda: checks.text("a\nb", "unit"), "unit is 'a\\nb', must be text without control characters"),
        (lambda: checks.seed(-1), "random_state is -1, must be None, an integer from 0 to 2**32 - 1"),
        (lambda: checks.array([1.0], "goal", (2,)), "goal has shape (1,), must have shape (2,)."),
        (lambda: checks.array([[1.0, np.inf]], "x", ("n", 2)), "x[0, 1] is inf, must be finite and at most 1e+100"),
        (
            lambda: checks.semidefinite(np.diag([1.0, -1.0]), "K"),
            "the smallest eigenvalue of K is -1.0, must be zero or",
        ),
        (
            lambda: checks.semidefinite(np.array([[1.0, 0.5], [0.0, 1.0]]), "K"),
            "the asymmetry of K is 0.5, must be zero",
        ),
    ],
)
def test_what_cannot_be_used_is_one_sentence_by_name(check, message):
    with pytest.raises(InvalidParameterError) as caught:
        check()
    assert str(caught.value).startswith(message)
    assert isinstance(caught.value, ValueError)
    assert isinstance(caught.value, TypeError)


def test_what_can_be_used_comes_back_as_what_to_go_on_with():
    assert type(checks.number(np.float32(0.5), "x", above=0.0)) is float
    assert checks.number(None, "x", optional=True) is None
    assert type(checks.count(np.int64(3), "n")) is int
    assert checks.array([1, 2], "x", ("n",)).dtype == np.float64
    # Units that are far apart are no lack of definiteness, and a covariance of zeros is semidefinite.
    checks.semidefinite(np.diag([1e-20, 1e20]), "covariance", definite=True)
    checks.semidefinite(np.zeros((3, 2, 2)), "covariance")


X, Y = np.tile(np.linspace(0.0, 1.0, 8), 3)[:, np.newaxis], np.random.default_rng(0).normal(size=(24, 4))
TWO_WAYS = Demonstrations(
    np.linspace(0.0, 1.0, 30), [s * np.ones((30, 2)) + 1e-3 * i for i in range(4) for s in (-1, 1)]
)


@pytest.mark.parametrize(
    "act",
    [
        lambda: CholeskyCovRegressor(max_iter=50).fit(X, Y),
        lambda: HeteroscedasticGPRegressor().fit(X, Y, groups=np.zeros(24, dtype=int)),
        lambda: GMMBaseline(n_components=1).fit(X[:4], Y[:4]),
        lambda: check_unimodal(TWO_WAYS),
        lambda: DMPController(GMMBaseline()).fit(TWO_WAYS),
        lambda: GMMBaseline(n_components=4, max_iter=1, tol=1e-12, n_restarts=0).fit(X, Y),
    ],
    ids=["few", "one group", "few rows", "two ways", "controller", "not converged"],
)
def test_92_warnings_point_at_the_line_that_called_the_package(act):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        act()
    assert caught
    assert {warning.filename for warning in caught} == {__file__}
