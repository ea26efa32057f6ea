"""Good manners: the same bits wherever and however a process runs, and the caller's things left as they were.

Numbers in the names are those of the list of faults that the project keeps. Also: tests/estimators/test_scikit_learn.py
(types, modes, forms of arrays, two fits, copies, n_jobs=2).
"""

import ast
import copy
import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from digests import MODELS, data, digest, digests, learned, predictions, put_digests
from estimators.zoo import VARIANTS, demonstrations, fit, new, random_states

import torch_pbd
from torch_pbd import DMPController, HeteroscedasticGPRegressor
from torch_pbd.data import Demonstrations
from torch_pbd.exceptions import UnimodalityWarning

PROGRAM = Path(__file__).with_name("digests.py")
LIMIT = 300.0  # s: a watchdog, far above what is needed


def run(*arguments, cwd=None, **variables):
    """The program in a process of its own, with these variables; None takes one away."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    environment = {name: value for name, value in {**environment, **variables}.items() if value is not None}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.splitlines()


FORK = """
import multiprocessing
from digests import digests, put_digests
print("\\n".join(digests()), flush=True)
context = multiprocessing.get_context("fork")
queue = context.Queue()
process = context.Process(target=put_digests, args=(queue,), daemon=True)
process.start()
try:
    print("\\n".join(queue.get(timeout=200.0)))
finally:
    process.kill()
"""


@pytest.fixture(scope="module")
def two_processes():
    """What another process says, with nothing out of the ordinary, and what one says that it forks after its fits."""
    lines = run("-c", FORK, PYTHONHASHSEED="0")
    return lines[: len(MODELS)], lines[len(MODELS) :]


@pytest.fixture(scope="module")
def expected(two_processes):
    return two_processes[0]


ASCII = {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
NOWHERE = dict.fromkeys(("HOME", "USER", "LOGNAME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"))


@pytest.mark.slow  # Python compiles all of torch anew, without docstrings
def test_32_another_process_gives_the_same_bits(expected):
    assert run(str(PROGRAM), PYTHONHASHSEED="4294967295", PYTHONOPTIMIZE="2") == expected


def test_32_so_does_this_one(expected):
    assert digests() == expected


ELSEWHERE = """
import locale, os, sys, tempfile
from pathlib import Path
import torch
import torch_pbd
torch.ones(9, 9) @ torch.ones(9, 9)  # oneMKL finds its kernels at their first use, and only from a folder that is there
for name in ("de_DE.UTF-8", "de_DE.utf8", "fr_FR.UTF-8", "nl_NL.UTF-8"):
    try:
        locale.setlocale(locale.LC_ALL, name)
        break
    except locale.Error:
        pass
print(locale.localeconv()["decimal_point"])
package = Path(torch_pbd.__file__).parent
before = sorted((str(path), path.stat().st_mtime_ns) for path in package.rglob("*.py*"))
written = []
def audit(event, arguments):
    if event == "open" and isinstance(arguments[0], str) and arguments[1] not in (None, "r", "rb"):
        written.append(arguments[0])
sys.addaudithook(audit)
folder = tempfile.mkdtemp()
os.chdir(folder)
os.rmdir(folder)
sys.path[:] = [path for path in sys.path if path]
from digests import digests
print("\\n".join(digests()))
assert not [path for path in written if path.startswith(str(package))], written
assert before == sorted((str(path), path.stat().st_mtime_ns) for path in package.rglob("*.py*"))
"""


def test_32_50_a_process_without_home_and_folder_with_other_hashes_and_locale_gives_the_same_bits(expected, tmp_path):
    """Its working folder is gone, its text is ASCII, its decimal point a comma; it writes nothing into the package."""
    if shutil.which("localedef"):  # which may say that a part of a locale is not there, and makes the rest
        made = ["localedef", "-i", "de_DE", "-f", "UTF-8", tmp_path / "de_DE.UTF-8"]
        subprocess.run(made, capture_output=True, check=False)
    odd = {"MPLCONFIGDIR": "/dev/null/nowhere", "PYTHONDONTWRITEBYTECODE": "1", "PYTHONHASHSEED": "1"}
    mark, *lines = run("-c", ELSEWHERE, LOCPATH=str(tmp_path), **NOWHERE, **odd, **ASCII)
    assert lines == expected
    if mark != ",":
        pytest.skip("no locale with a decimal comma can be made here; all else was tested")


@pytest.fixture
def decimal_comma(monkeypatch):
    """As if the locale had one, for what asks it."""
    import locale

    convention = {**locale.localeconv(), "decimal_point": ",", "thousands_sep": "."}
    monkeypatch.setattr(locale, "localeconv", lambda: convention)


def test_50_files_have_a_decimal_point_whatever_the_locale(decimal_comma, tmp_path):
    from torch_pbd import load_demonstrations, save_demonstrations

    recorded = Demonstrations([[0.0, 0.5], [0.0, 1.5]], [[[1.25], [2.5]], [[1e-3], [7.0]]])
    save_demonstrations(recorded, tmp_path / "set.csv")
    assert "0,0.5,2.5\n" in (tmp_path / "set.csv").read_text()
    assert load_demonstrations(tmp_path / "set.csv") == recorded


@pytest.mark.slow  # whose fits are those of a program, above
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_34_a_started_process_fits_as_this_one(method, expected):
    assert in_process(multiprocessing.get_context(method)) == expected


def in_process(context):
    queue = context.Queue()
    process = context.Process(target=put_digests, args=(queue,), daemon=True)
    process.start()
    try:
        told = queue.get(timeout=LIMIT)
        process.join(LIMIT)
    finally:
        process.kill()
    return told


def test_34_a_process_forked_after_a_fit_fits_too(two_processes):
    before, told = two_processes
    assert told == before


def test_32_the_default_type_of_torch_changes_nothing(expected):
    before = torch.get_default_dtype()
    try:
        for kind in (torch.float16, torch.float32):
            torch.set_default_dtype(kind)
            assert digest("cholesky") == expected[0]
    finally:
        torch.set_default_dtype(before)


def test_32_two_threads_at_once_give_what_one_gives(expected):
    digests()  # the first fits of a process import libraries, and sympy adds a filter of its own
    before = random_states()
    told, failed = {}, []
    start = threading.Barrier(2)

    def work(number):
        start.wait(LIMIT)
        try:
            names = list(MODELS)[::-1] if number else list(MODELS)
            told[number] = {name: digest(name) for name in names}
        except BaseException as error:
            failed.append(error)
            raise

    threads = [threading.Thread(target=work, args=(number,), daemon=True) for number in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LIMIT)
    assert not failed
    assert list(told[0].values()) == expected
    assert told[0] == told[1]
    assert random_states() == before


def test_32_a_fit_in_one_thread_silences_no_warning_of_another(monkeypatch):
    """`warnings.catch_warnings` would: its filters are those of all threads."""
    from torch_pbd.estimators import heteroscedastic

    inside, seen = heteroscedastic.HeteroscedasticGPRegressor._fit, []

    def watched(self, *args, **told):
        seen.append(warnings.filters[:])
        return inside(self, *args, **told)

    monkeypatch.setattr(heteroscedastic.HeteroscedasticGPRegressor, "_fit", watched)
    learned("controller")
    assert seen == [warnings.filters]


def test_32_of_several_ways_a_controller_is_told_once_and_a_regressor_too():
    time = np.linspace(0.0, 1.0, 15)
    ways = np.sin(np.pi * time) * np.array([[1.0], [1.02], [0.98], [-1.0], [-1.01], [-0.99]])
    recorded = Demonstrations(time, ways[:, :, np.newaxis], units="m")
    X, y, groups = recorded.stack()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        DMPController(HeteroscedasticGPRegressor(), n_steps=20).fit(recorded)
    assert len([w for w in caught if issubclass(w.category, UnimodalityWarning)]) == 1
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        HeteroscedasticGPRegressor().fit(X, y, groups=groups)
    assert len([w for w in caught if issubclass(w.category, UnimodalityWarning)]) == 1


@pytest.fixture(scope="module")
def plain():
    """What a controller predicts."""
    return predictions(learned("controller"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode], ids=lambda m: m.__name__)
def test_32_33_a_controller_works_in_any_mode_and_leaves_it(mode, dtype, plain):
    default = torch.get_default_dtype()
    try:
        torch.set_default_dtype(dtype)
        with mode():
            before = random_states()
            here = predictions(learned("controller"))
            assert random_states() == before
    finally:
        torch.set_default_dtype(default)
    for mine, theirs in zip(here, plain, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def given_arrays(name):
    """X, y and groups, and an estimator whose parameters are arrays and lists."""
    X, y = demonstrations()
    parameters = {} if "mixture" in name else {"length_scale": [0.5], "prior": np.array([[4.0, 1.0], [1.0, 3.0]])}
    told = {"groups": np.repeat(np.arange(12), 8)} if name.startswith("heteroscedastic") else {}
    return new(name, **parameters), X, y, told


@pytest.mark.filterwarnings("ignore:length_scale is so long")
@pytest.mark.parametrize("name", VARIANTS)
def test_35_what_the_caller_gave_is_not_changed_nor_kept(name):
    estimator, X, y, told = given_arrays(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        estimator.fit(X, y, **told)
    X_kept, parameters = X.copy(), copy.deepcopy(estimator.get_params())
    fresh = given_arrays(name)
    for mine, theirs in zip((X, y, *told.values()), (fresh[1], fresh[2], *fresh[3].values()), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for key, value in fresh[0].get_params().items():
        np.testing.assert_equal(parameters[key], value)
    before = estimator.predict(X_kept, return_cov=True)
    X[:], y[:] = 99.0, -99.0
    for array in told.values():
        array[:] = 0
    if "mixture" not in name:
        estimator.prior[:], estimator.length_scale[:] = 7.0, [7.0]
    for mine, theirs in zip(estimator.predict(X_kept, return_cov=True), before, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("name", VARIANTS)
def test_35_what_is_returned_is_the_callers(name):
    model = fit(new(name), *demonstrations())
    X = np.linspace(-2.0, 2.0, 9)[:, np.newaxis]
    asked = X.copy()

    def answers():
        mean, std = model.predict(X, return_std=True)
        return [
            model.predict(X),
            mean,
            std,
            model.predict_cov(X),
            *model.predict_uncertainty(X),
            model.sample_y(X, 2, 0),
        ]

    before = [part.copy() for part in answers()]
    loss = model.loss_
    for part in (*answers(), model.log_likelihood(X, np.zeros((9, 2)))):
        assert part.flags.writeable
        part[...] = np.nan
    model.loss_curve_[:] = [np.nan]
    for mine, theirs in zip(answers(), before, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert model.loss_ == loss
    np.testing.assert_array_equal(X, asked)


def test_35_a_controllers_arrays_are_the_callers_or_read_only():
    X, y, groups = data()
    kept = X.copy(), y.copy(), groups.copy()
    model = DMPController(n_steps=40).fit(X, y, groups=groups)
    times = np.linspace(0.0, 10.0, 7)[:, np.newaxis]
    force = np.zeros((201, 2))
    schedule = model.schedule(20.0)
    before = [part.copy() for part in (model.predict(times), model.predict_stiffness(times), schedule.stiffness)]
    run_of = model.simulate(force=force, rate=20.0)
    given = [model.predict(times), model.predict_stiffness(times), model.predict_damping(times)]
    for part in (*given, schedule.stiffness, schedule.position, run_of.position, run_of.stiffness, force):
        if part.flags.writeable:
            part[...] = np.nan
    after = (model.predict(times), model.predict_stiffness(times), model.schedule(20.0).stiffness)
    for mine, theirs in zip(after, before, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for mine, theirs in zip((X, y, groups), kept, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_35_parameters_of_a_controller_are_not_edited():
    covariance = HeteroscedasticGPRegressor(length_scale=[3.0])
    model = DMPController(covariance, n_steps=40)
    before = repr(model.get_params())
    X, y, groups = data()
    model.fit(X, y, groups=groups).schedule(20.0)
    assert repr(model.get_params()) == before
    assert model.covariance is covariance
    assert not hasattr(covariance, "module_")


def test_what_users_give_is_checked_by_no_assert():
    """PYTHONOPTIMIZE takes asserts away: they only tell types that what stands before them has made sure of."""
    for file in Path(torch_pbd.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Assert):
                assert ast.unparse(node.test).endswith(" is not None"), f"{file}, line {node.lineno}"
