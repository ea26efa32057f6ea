"""Model files forged by somebody who knows the format, and makes the checksum right.

Nothing may be executed, no attribute set that closed tables do not name, nothing allocated that is not in the file;
what cannot be told from a sound model is believed.
"""

import json
import tracemalloc

import numpy as np
import pytest
from file_kinds import GOLDEN, MODELS, load_all
from safetensors.numpy import save as to_bytes

import torch_pbd
from torch_pbd.exceptions import ModelFileError
from torch_pbd.persistence import checksum, read_archive

LAW = {"stiffness_law": {"stiffness_min": 50.0, "stiffness_max": 1000.0, "sigma_low": 0.1, "sigma_high": 0.2,
                         "bounds": "sigma", "smooth": False}}  # fmt: skip


def parts(name):
    """Header and arrays of a sound file."""
    return read_archive(GOLDEN / f"{name}.safetensors")


def forge(tmp_path, header, arrays):
    path = tmp_path / "forged.safetensors"
    text = json.dumps({**header, "sha256": checksum(header, arrays)})
    path.write_bytes(to_bytes(dict(arrays), metadata={"torch_pbd": text}))
    return path


def assert_refused(path, words="", most=2**22):
    load_all()
    tracemalloc.start()
    try:
        with pytest.raises(ModelFileError, match=rf"forged\.safetensors.*{words}"):
            torch_pbd.load(path)
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def replaced(entries, place, value):
    """A copy of nested entries with the one at ``place`` replaced; it is added where it is not there."""
    name, *rest = place
    inner = replaced(entries.get(name, {}), rest, value) if rest else value
    return {**entries, name: inner}


@pytest.mark.parametrize("name", MODELS)
def test_what_is_forged_of_sound_parts_loads(name, tmp_path):
    assert type(torch_pbd.load(forge(tmp_path, *parts(name)))).__name__ == name


@pytest.mark.parametrize("version", [2, 0, "1", None, 1.0, True])
def test_43_a_format_that_is_not_ours_is_not_guessed_at(version, tmp_path):
    header, arrays = parts("GMMBaseline")
    assert_refused(
        forge(tmp_path, {**header, "format_version": version}, arrays),
        rf"has format version {version}; this torch_pbd reads 1\. Upgrade it",
    )


@pytest.mark.parametrize(
    "name", ["RandomForest", "os.system", "__import__", "", None, ["GMMBaseline"], {}, "x" * 10**6]
)
def test_43_a_class_that_is_not_ours_is_refused(name, tmp_path):
    header, arrays = parts("CholeskyCovRegressor")
    assert_refused(
        forge(tmp_path, {**header, "class": name}, arrays), r"holds a .*; known are Heteroscedastic", most=2**24
    )


@pytest.mark.parametrize("other", MODELS)
@pytest.mark.parametrize("name", MODELS)
def test_43_a_model_under_the_name_of_another_class_is_refused(name, other, tmp_path):
    header, arrays = parts(name)
    if name != other:
        assert_refused(forge(tmp_path, {**header, "class": other}, arrays), f"does not describe a whole {other}")


@pytest.mark.parametrize("other", MODELS[:-1])
@pytest.mark.parametrize("name", MODELS[:-1])
def test_43_a_model_with_parameters_of_another_class_is_refused(name, other, tmp_path):
    header, arrays = parts(name)
    learned = {**header["fitted"], **parts(other)[0]["fitted"]}
    wanted = {key: learned[key] for key in parts(other)[0]["fitted"]}
    if name != other:
        forged = {**header, "class": other, "params": {}, "fitted": wanted}
        assert_refused(forge(tmp_path, forged, arrays), "its model is of another class")


BOMBS = [
    {"array": [1], "dtype": dtype}
    for dtype in ("V1000000000", "U1000000000", "S1000000000", "f8,f8", "(1000000000,)f8", "O", "M8[s]", "nonsense", 8)
]
NOT_PLAIN = [
    *BOMBS,
    {"array": [[1, [2]]], "dtype": "float64"},
    {"array": ["1.5"], "dtype": "float64"},
    {"array": [None], "dtype": "float64"},
    {"array": [1.5], "dtype": "int64"},
    {"array": [2**70], "dtype": "int64"},
    {"array": [[["a"], ["b", "c"]]], "dtype": "object"},
    {"array": [{"array": [1], "dtype": "float64"}], "dtype": "object"},
    {"array": {"array": []}, "dtype": "float64"},
    {"__reduce__": ["os.system", "true"]},
    {"class": "GMMBaseline", "params": {}},
    LAW,
    [[LAW]],
    {},
]


@pytest.mark.parametrize("value", NOT_PLAIN, ids=str)
@pytest.mark.parametrize("parameter", ["prior", "max_iter", "random_state"])
def test_43_parameters_are_plain_numbers_text_and_arrays(parameter, value, tmp_path):
    header, arrays = parts("CholeskyCovRegressor")
    assert_refused(forge(tmp_path, replaced(header, ["params", parameter], value), arrays))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (["params"], None),
        (["params"], []),
        (["params", "unheard_of"], 1),
        (["params", "self"], 1),
        (["params", "device"], 0),
        (["params", "device"], ["cpu"]),
        (["params", "device"], "meta"),
        (["fitted"], [1, 2]),
        (["fitted"], {}),
        (["fitted", "predict"], 5),
        (["fitted", "module_"], 5),
        (["fitted", "prior"], 5.0),
        (["fitted", "_door"], None),
        (["fitted", "__class__"], "str"),
        (["fitted", "__dict__"], {}),
        (["fitted", "_module_spec"], {"covariance": "mixture"}),
        (["fitted", "n_features_in_"], 10**12),
        (["fitted", "n_features_in_"], 2),
        (["fitted", "n_features_in_"], True),
        (["fitted", "n_outputs_"], 10**12),
        (["fitted", "n_outputs_"], 1),
        (["fitted", "n_outputs_"], 2.0),
        (["fitted", "_y_is_1d"], True),
        (["fitted", "_y_is_1d"], "no"),
        (["fitted", "_y_is_1d"], {"array": [True, False], "dtype": "bool"}),
        (["fitted", "converged_"], 1),
        (["fitted", "loss_"], "low"),
        (["fitted", "loss_"], 10**400),
        (["fitted", "loss_curve_"], [1.0, [2.0]]),
        (["fitted", "jitter_"], float("nan")),
        (["fitted", "feature_names_in_"], {"array": ["a", "b"], "dtype": "object"}),
        (["fitted", "feature_names_in_"], {"array": [0.5], "dtype": "float64"}),
        (["fitted", "feature_names_in_"], {"array": [["a"]], "dtype": "object"}),
        (["fitted", "feature_names_in_"], ["time"]),
        (["module"], None),
        (["module"], {}),
        (["module", "covariance"], "neural"),
        (["module", "covariance"], ["cholesky"]),
        (["module", "log_diagonal"], "no"),
        (["module", "log_diagonal"], 0),
        (["module", "kernel"], "__import__"),
        (["module", "kernel"], ["squared_exponential"]),
        (["module", "mean_kernel"], "periodic"),
        (["module", "stranger"], 1),
        (["stranger"], 1),
        (["versions"], "1.0"),
    ],
    ids=str,
)
def test_43_a_header_that_does_not_describe_a_model_is_refused(place, value, tmp_path):
    header, arrays = parts("CholeskyCovRegressor")
    assert_refused(forge(tmp_path, replaced(header, place, value), arrays), "does not describe a whole CholeskyCov")


@pytest.mark.parametrize(
    ("name", "place", "value"),
    [
        ("GMMBaseline", ["module", "n_features"], 10**12),
        ("GMMBaseline", ["module", "n_features"], 1.0),
        ("GMMBaseline", ["module", "n_features"], 0),
        ("WishartProcessRegressor", ["fitted", "df_"], 7),
        ("WishartProcessRegressor", ["module", "log_diagonal"], True),
        ("HeteroscedasticGPRegressor", ["fitted", "effective_share_"], None),
        ("HeteroscedasticGPRegressor", ["module", "exact"], [True, True, 1]),
        ("HeteroscedasticGPRegressor", ["module", "exact"], [True, True]),
        ("HeteroscedasticGPRegressor", ["module", "kernel"], "linear"),
        ("HeteroscedasticGPRegressor", ["module", "medians"], [[0.3, 1.2, 0.0]]),
        ("HeteroscedasticGPRegressor", ["module", "medians"], [[0.3, 1.2, 0.0], [0.5, 1.0, 2.0], [0.5, -0.3, 1.0]]),
        ("HeteroscedasticGPRegressor", ["module", "medians"], [[0.3, 1.2, 0.0], [0.5, 1.0, 2.0], [0.5, 0.3, np.nan]]),
        ("HeteroscedasticGPRegressor", ["module", "medians"], [[0.3, 1.2, 1.0], [0.5, 1.0, 2.0], [0.5, 0.3, 1.0]]),
        ("DMPController", ["fitted", "law_"], None),
        ("DMPController", ["fitted", "law_"], {"stiffness_law": {}}),
        ("DMPController", ["fitted", "law_", "stiffness_law", "smooth"], "no"),
        ("DMPController", ["fitted", "law_", "stiffness_law", "stiffness_max"], -1.0),
        ("DMPController", ["fitted", "law_", "stiffness_law", "__class__"], "x"),
        ("DMPController", ["fitted", "duration_"], 0.0),
        ("DMPController", ["fitted", "duration_"], float("nan")),
        ("DMPController", ["fitted", "duration_"], 10**400),
        ("DMPController", ["fitted", "n_outputs_"], 3),
        ("DMPController", ["fitted", "names_"], ["x"]),
        ("DMPController", ["fitted", "names_"], "xy"),
        ("DMPController", ["fitted", "units_"], ["m", 1]),
        ("DMPController", ["fitted", "predict"], 1),
        ("DMPController", ["fitted", "time_unit_"], None),
        ("DMPController", ["params", "mass"], "heavy"),
        ("DMPController", ["params", "mass"], -1.0),
        ("DMPController", ["params", "alpha"], float("nan")),
        ("DMPController", ["params", "gate"], "open"),
        ("DMPController", ["params", "n_steps"], -5),
        ("DMPController", ["params", "stiffness_law"], 5),
        ("DMPController", ["params", "covariance"], {"class": "DMPController", "params": {}}),
        ("DMPController", ["params", "covariance"], {"class": "GMMBaseline", "params": {"prior": LAW}}),
        ("DMPController", ["params", "covariance", "class"], "os.system"),
        ("DMPController", ["covariance_"], None),
        ("DMPController", ["covariance_", "class"], "DMPController"),
        ("DMPController", ["covariance_", "class"], "CholeskyCovRegressor"),
        ("DMPController", ["covariance_", "fitted", "n_features_in_"], 2),
        ("DMPController", ["covariance_", "versions"], {}),
        ("DMPController", ["module"], {"covariance": "mixture", "n_features": 1}),
    ],
    ids=str,
)  # fmt: skip
def test_43_headers_of_the_other_classes(name, place, value, tmp_path):
    header, arrays = parts(name)
    assert_refused(forge(tmp_path, replaced(header, place, value), arrays), f"does not describe a whole {name}")


def test_43_nesting_that_never_ends_is_refused(tmp_path):
    header, arrays = parts("DMPController")
    nested = None
    for _ in range(200):
        nested = {"class": "DMPController", "params": {"covariance": nested}}
    assert_refused(forge(tmp_path, replaced(header, ["params", "covariance"], nested), arrays))
    deep = "[" * 900 + "]" * 900
    for place in (["params", "prior"], ["fitted", "loss_curve_"]):
        header, arrays = parts("CholeskyCovRegressor")
        assert_refused(
            forge(tmp_path, replaced(header, place, json.loads(deep)), arrays)
            if place[0] == "fitted"
            else forge(tmp_path, replaced(header, place, {"array": json.loads(deep), "dtype": "float64"}), arrays)
        )


def test_43_parameters_of_a_fit_allocate_nothing_at_load(tmp_path):
    header, arrays = parts("GMMBaseline")
    load_all()
    for name in ("n_components", "n_restarts", "max_iter"):
        tracemalloc.start()
        try:
            model = torch_pbd.load(forge(tmp_path, replaced(header, ["params", name], 10**12), arrays))
            assert tracemalloc.get_traced_memory()[1] < 2**22
        finally:
            tracemalloc.stop()
        assert getattr(model, name) == 10**12  # as a fit would be asked for; what it learned is in the arrays
        assert model.predict([[0.0]]).shape == (1,)


@pytest.mark.parametrize("name", MODELS)
def test_43_each_array_is_needed_in_its_shape_and_type_and_finite(name, tmp_path):
    header, arrays = parts(name)
    for key, array in arrays.items():
        for wrong in (
            np.zeros(11),
            np.zeros((1,) * (array.ndim + 1)),
            array[..., np.newaxis] if array.size > 1 else np.zeros(3),
            array.astype(np.float32),
            np.zeros(array.shape, dtype=np.int64),
            np.zeros((0, *array.shape[1:])),
            np.full(array.shape, np.nan),
        ):
            assert_refused(forge(tmp_path, header, {**arrays, key: wrong}), f"does not describe a whole {name}")
        assert_refused(forge(tmp_path, header, {other: arrays[other] for other in arrays if other != key}))
        if "floor" not in key and "period" not in key:
            spoiled = array.copy()
            spoiled.flat[-1] = np.inf
            assert_refused(forge(tmp_path, header, {**arrays, key: spoiled}), "finite")
    for stranger in ("stranger", "core.stranger", "covariance_.stranger", "module_", "forward", "core.forward", ""):
        assert_refused(forge(tmp_path, header, {**arrays, stranger: np.zeros(2)}))


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("CholeskyCovRegressor", "core.covariance.prior_tril", [[1.0, 0.0], [0.3, -1.0]]),
        ("CholeskyCovRegressor", "core.covariance.prior_tril", [[1.0, 0.0], [0.3, 0.0]]),
        ("CholeskyCovRegressor", "core.covariance.prior_tril", [[1.0, 0.3], [0.3, 1.0]]),
        ("HeteroscedasticGPRegressor", "core.prior_tril", [[0.0, 0.0], [0.3, 1.0]]),
        ("HeteroscedasticGPRegressor", "core.pooled_tril", [[1.0, 0.5], [0.3, 1.0]]),
        ("CholeskyCovRegressor", "y_scale", [1.0, 0.0]),
        ("WishartProcessRegressor", "x_scale", [-1.0]),
        ("WishartProcessRegressor", "core.mean.amplitude", [-1.0, 1.0]),
        ("WishartProcessRegressor", "core.mean.noise_ratio", [-1.0, 1.0]),
        ("GMMBaseline", "core.log_diagonal", [[1e4, 0.0], [0.0, 0.0]]),
        ("GMMBaseline", "core.log_diagonal", [[-1e4, 0.0], [0.0, 0.0]]),
    ],
)  # fmt: skip
def test_43_numbers_that_cannot_be_of_a_model_are_refused(name, key, value, tmp_path):
    header, arrays = parts(name)
    assert arrays[key].shape == np.shape(value)
    assert_refused(forge(tmp_path, header, {**arrays, key: np.array(value)}))


def test_43_shapes_that_would_broadcast_to_more_than_the_memory_are_refused(tmp_path):
    header, arrays = parts("GMMBaseline")
    wide = {
        "core.mean": np.zeros((1, 10**5)),
        "core.log_diagonal": np.zeros((1, 10**5)),
        "core.log_weight": np.zeros(1),
    }
    assert_refused(forge(tmp_path, header, {**arrays, **wide}), "size mismatch", most=2**25)
    header, arrays = parts("CholeskyCovRegressor")
    n = 10**6
    latent = "core.covariance.latent."
    many = {
        "inputs": np.zeros((n, 1)),
        "weight": np.zeros((3, n)),
        "value_weight": np.zeros((3, n)),
        "counts": np.ones(n),
    }
    forged = forge(tmp_path, header, {**arrays, **{latent + key: value for key, value in many.items()}})
    assert_refused(forged, "a model of 1000000 inputs needs about .* GiB", most=2**29)


@pytest.mark.parametrize("name", ["CholeskyCovRegressor", "GMMBaseline"])
def test_a_subclass_that_bears_the_name_is_not_saved_as_ours(name, tmp_path):
    model = torch_pbd.load(GOLDEN / f"{name}.safetensors")
    impostor = type(name, (type(model),), {})()
    impostor.__dict__.update(vars(model))
    with pytest.raises(TypeError, match=f"estimator is a {name}; can save"):
        torch_pbd.save(impostor, tmp_path / "model")


def test_what_could_not_be_loaded_again_is_not_saved(tmp_path):
    path = tmp_path / "model"
    model = torch_pbd.load(GOLDEN / "CholeskyCovRegressor.safetensors")
    model.note = "mine"
    with pytest.raises(TypeError, match="attribute 'note', which a model file cannot hold: delete it, or pickle"):
        torch_pbd.save(model, path)
    del model.note
    model.module_.y_shift[0] = np.nan
    with pytest.raises(ValueError, match=r"cannot be saved, as it is not sound: y_shift\[0\] is nan, must be finite"):
        torch_pbd.save(model, path)
    controller = torch_pbd.load(GOLDEN / "DMPController.safetensors")
    with pytest.raises(ValueError, match="the DMPController cannot be saved, as it is not sound: gate is 'open'"):
        torch_pbd.save(controller.set_params(gate="open"), path)
    assert list(tmp_path.iterdir()) == []
