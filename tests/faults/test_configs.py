"""Configurations that cannot be used: one line with file, line, key and remedy, before any work.

Numbers in the names are those of the list of faults that the project keeps.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from torch_pbd import CholeskyCovRegressor, GMMBaseline, HeteroscedasticGPRegressor, WishartProcessRegressor
from torch_pbd.cli.commands import COMMANDS, parse
from torch_pbd.cli.main import main
from torch_pbd.cli.values import MAX_BYTES, read_yaml, read_yaml_file
from torch_pbd.exceptions import ConfigError

CONFIGS = sorted((Path(__file__).parents[2] / "configs").rglob("*.yaml"))
COMMAND_OF = {"robot": "experiment", "pose": "experiment"}


@pytest.fixture
def refused(tmp_path, capsys, monkeypatch):
    """What the command says of a config; that it is one line, with exit code 2, before the folder of results."""
    monkeypatch.chdir(tmp_path)

    def complaint(command, text, *arguments):
        config = tmp_path / "c.yaml"
        config.write_bytes(text if isinstance(text, bytes) else text.encode())
        assert main([command, "--config", "c.yaml", "--output", "out", *arguments]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("torch-pbd: ")
        assert err.count("\n") == 1
        assert "Parser key" not in err
        assert [path.name for path in tmp_path.iterdir()] == ["c.yaml"]
        return err.removeprefix("torch-pbd: ").rstrip("\n")

    return complaint


def in_model(init_args, name="GMMBaseline"):
    return f"data: x\nmodel:\n  class_path: {name}\n  init_args: {init_args}\n"


def in_controller(init_args):
    return f"controllers:\n  mine:\n    class_path: DMPController\n    init_args: {init_args}\n"


@pytest.mark.parametrize(
    ("command", "text", "message"),
    [
        ("fit", "data: x\nmodle: y\n", "c.yaml, line 2: modle is not an option of this command. Did you mean 'model'?"),
        ("compare", "models_: {}\n", "Did you mean 'models'?"),
        ("fit", "models: {}\n", "models is not an option of this command. Did you mean 'model'?"),
        ("demo", "zzzzz: 1\n", "Known are output, resume, n_demos, seed."),
        ("fit", in_model("{n_component: 3}"), "c.yaml, line 4: model.init_args.n_component is not a parameter of GMMB"),
        ("fit", in_model("{n_component: 3}"), "Did you mean 'n_components'?"),
        ("fit", in_model("{kernell: 3}"), "Known are n_components, solver, reg_covar"),  # CD has a kernel, it has none
        ("fit", in_model("{n_components: 3}", "CholeskyCovRegressor"), "is not a parameter of CholeskyCovRegressor"),
        ("fit", "model: {init_args: {n_components: 3}}", "is not a parameter of HeteroscedasticGPRegressor"),
        ("fit", "model: {class_path: GMMBaseline, init_arg: {}}", "model.init_arg is not a key here"),
        ("fit", "model: {tol: 1}", "model.tol is not a key here; parameters stand below init_args"),
        ("fit", "model: {class_path: GMMBaseline, dict_kwargs: {a: 1}}", "model.dict_kwargs is not a key here"),
        ("compare", "models: {a: {init_args: {}}}", "models.a has no class_path, must be one of Heterosc"),
        ("fit", "model: GMMBasline", "c.yaml, line 1: model == 'GMMBasline' is not a class that can be used here."),
        ("fit", "model: GMMBasline", "Did you mean 'GMMBaseline'?"),
        ("fit", "model: DMPController", "is not a class that can be used here. Known are HeteroscedasticGPRegressor"),
        ("experiment", in_controller("{gatee: none}"), "c.yaml, line 4: controllers.mine.init_args.gatee is not a par"),
        ("experiment", in_controller("{gatee: none}"), "Did you mean 'gate'?"),
        ("experiment", in_controller("{stiffness_law: {stiffness_mx: 1}}"), "stiffness_law.stiffness_mx is not"),
        ("experiment", in_controller("{covariance: {class_path: GMMBaseline, init_args: {tl: 1}}}"), "mean 'tol'?"),
        ("experiment", in_controller("{covariance: DMPController}"), "mine.init_args.covariance == 'DMPController' is"),
        ("fit", "config: d.yaml", "config is not an option of this command"),
        ("fit", "print_config: true", "print_config is not an option of this command"),
    ],
)
def test_45_unknown_keys_get_the_nearest_that_is_valid_there(refused, command, text, message):
    assert message in refused(command, text)


@pytest.mark.parametrize(
    ("command", "text", "message"),
    [
        ("fit", in_model("{tol: soon}"), "line 4: model.init_args.tol is the text 'soon', must be a number."),
        ("fit", in_model("{tol: '1e-3'}"), "tol is the text '1e-3', must be a number"),
        ("fit", in_model("{tol: '1:20'}"), "tol is the text '1:20', must be a number"),
        ("fit", in_model("{tol: true}"), "tol is true, must be a number"),
        ("fit", in_model("{tol: null}"), "tol is null, must be a number"),
        ("fit", in_model("{n_components: 010}"), "is the text '010', must be a whole number: write 10."),
        ("fit", in_model("{n_components: 0o10}"), "is the text '0o10', must be a whole number."),
        ("fit", in_model("{n_components: 0x10}"), "is the text '0x10', must be a whole number."),
        ("fit", in_model("{max_iter: 1_000}"), "is the text '1_000', must be a whole number: write 1000."),
        ("fit", in_model("{max_iter: 1:20}"), "is the text '1:20', must be a whole number."),
        ("fit", in_model("{max_iter: 2026-01-01}"), "is the text '2026-01-01', must be a whole number."),
        ("fit", in_model("{max_iter: 1e3}"), "is the number 1000.0, must be a whole number: write 1000."),
        ("fit", in_model("{max_iter: 2.5}"), "is the number 2.5, must be a whole number."),
        ("fit", in_model("{tol: 1e999}"), "line 4: there is the number 1e999, beyond what a float holds"),
        ("fit", in_model("{tol: .nan}"), "tol is not a number (.nan), must be a number"),
        ("fit", in_model("{kernel: matern}", "CholeskyCovRegressor"), "one of squared_exponential, matern32, matern52"),
        ("fit", in_model("{latent_prior: yes}", "CholeskyCovRegressor"), "must be true or false: write true."),
        ("fit", in_model("{latent_prior: 0}", "CholeskyCovRegressor"), "the number 0, must be true or false."),
        ("fit", in_model("{length_scale: [1, a]}", "CholeskyCovRegressor"), "length_scale.1 is the text 'a'"),
        ("fit", in_model("{length_scale: []}", "CholeskyCovRegressor"), "length_scale is empty"),
        ("fit", in_model("{prior: [[1, 0], [0, a]]}", "CholeskyCovRegressor"), "prior.1.1 is the text 'a'"),
        ("fit", in_model("{device: 0}"), "the number 0, must be text or null: text that looks like something else"),
        ("fit", in_model("3"), "model.init_args is the number 3, must be a mapping"),
        ("fit", in_model("[tol]"), "model.init_args is a list, must be a mapping"),
        ("fit", "model: 3", "model is the number 3, must be a mapping of class_path and init_args."),
        ("fit", "model: [GMMBaseline]", "model is a list, must be"),
        ("fit", "model:", "model is null, must be"),
        ("fit", "model: {class_path: 7}", "model.class_path == 7 is not a class that can be used here"),
        (
            "fit",
            "data: 7",
            "data is the number 7, must be text or a list, each entry text or null: text that looks "
            "like something else stands in quotes.",
        ),
        ("fit", "data: {a: b}", "data is a mapping, must be text or a list, each entry text or null."),
        ("fit", "data: a\nalign: dwt", "must be one of auto, none, phase, dtw: did you mean 'dtw'?"),
        ("fit", "data: a\nn_steps: None", "must be a whole number of at least 2 or null: write null."),
        ("fit", "data: a\nn_steps: 2.5", "n_steps is the number 2.5, must be a whole number of at least 2 or null."),
        ("fit", "data: a\nn_steps: 0", "n_steps is the number 0, must be a whole number of at least 2 or null."),
        ("demo", "n_demos: 2.5", "n_demos is the number 2.5, must be a whole number of at least 1."),
        ("demo", "n_demos: true", "n_demos is true, must be a whole number of at least 1."),
        ("demo", "n_demos: 6.0", "must be a whole number of at least 1: write 6."),
        ("demo", "seed: -1", "seed is the number -1, must be a whole number from 0 to 4294967294."),
        ("demo", "resume: yes", "resume is the text 'yes', must be true or false: write true."),
        ("compare", "readings: bell", "readings is the text 'bell', must be a list"),
        ("compare", "readings: []", "readings is empty"),
        (
            "compare",
            "readings: [bel]",
            "readings.0 is the text 'bel', must be one of bell, printed, bowl: did you mean",
        ),
        ("compare", "models: {}", "models is empty"),
        ("compare", "models: [GMMBaseline]", "models is a list, must be a mapping"),
        ("compare", "models: {a: }", "models.a is null, must be"),
        ("compare", "max_folds: -1", "max_folds is the number -1, must be a whole number of at least 0."),
        ("compare", "n_jobs: 0", "n_jobs is the number 0, must be a whole number of at most -1 or"),
        ("experiment", "controllers: [a]", "controllers is a list, must be a mapping"),
        ("experiment", "controllers: {a: 3}", "controllers.a is the number 3, must be"),
        ("experiment", "rate: .inf", "rate is infinite (.inf), must be a number from 0.001 to 1e+06."),
        (
            "experiment",
            "push: 1,5",
            "push is the text '1,5', must be a number from 0 to 1e+06: write 1.5.",
        ),
        ("experiment", in_controller("{stiffness_law: 5}"), "stiffness_law is the number 5, must be"),
        ("experiment", in_controller("{damping_ratio: papr}"), "must be a number or paper: did you mean 'paper'?"),
        (
            "experiment",
            in_controller("{stiffness_law: {stiffness_max: -3}}"),
            "controllers.mine.stiffness_law: stiffne",
        ),
    ],
)
def test_45_wrong_types_are_told_with_what_to_write(refused, command, text, message):
    assert message in refused(command, text)


@pytest.mark.parametrize(
    ("command", "text", "message"),
    [
        ("compare", "models: {CD: GMMBaseline, cd: GMMBaseline}", "models: 'CD' and 'cd' would both be written to"),
        ("compare", "models: {'!!!': GMMBaseline, '???': GMMBaseline}", "models: '!!!' gives no name of a file"),
        ("compare", "models: {'': GMMBaseline}", "models: '' gives no name of a file"),
        ("experiment", "controllers: {a b: {}, A-B: {}}", "controllers: 'a b' and 'A-B' would both be written to"),
    ],
)
def test_names_whose_files_would_replace_each_other_are_refused(refused, command, text, message):
    assert message in refused(command, text)


def bomb():
    levels = ["a: &a [x]"] + [
        f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    ]
    return "\n".join(levels)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("data: a\nn_steps: 3\ndata: b", "c.yaml, line 3: there is the key 'data' twice (first in line 1): keep one"),
        ("data: a\n'data': b", "line 2: there is the key 'data' twice"),
        (in_model("{tol: 1, max_iter: 3, tol: 2}"), "line 4: there is the key 'tol' twice (first in line 4)"),
        ("5: a\n5: b", "line 2: there is the key '5' twice"),
        ("true: a", "true is not an option of this command"),
        ("?\n: a", "'' is not an option of this command"),
        ("? [a, b]\n: c", "there is a mapping or a list as a key"),
        ("? {a: b}\n: c", "there is a mapping or a list as a key"),
        ("data: !!str 7", "c.yaml, line 1: there is a tag (!): write the plain value."),
        ("data: ! 7", "there is a tag (!)"),
        ("data: !!python/object/apply:os.system ['touch canary']", "there is a tag (!)"),
        ("output: x\ndata: !!python/name:os.system", "line 2: there is a tag"),
        ("data: !Ref x", "there is a tag (!)"),
        ("data: *a", "there is a reference (*): write the value out."),
        ("model: &m {init_args: *m}", "there is a reference (*)"),
        ("model:\n  <<: {class_path: GMMBaseline}", "c.yaml, line 2: model.<< is not a key here"),
        ("data: a\n---\ndata: b", "c.yaml, line 2: this is not YAML: expected a single document"),
        (bomb(), "there is a reference (*)"),
        ("model: " + "[" * 3000, "there is nesting of more than 50 levels"),
        ("model: " + "[" * 3000 + "]" * 3000, "there is nesting of more than 50 levels"),
        ("model:\n" + "".join(" " * i + "a:\n" for i in range(1, 999)), "there is nesting of more than 50 levels"),
        ("- " * 3000, "there is nesting of more than 50 levels"),
        ("? " * 3000, "there is nesting of more than 50 levels"),
        ("model: [" + "x," * 30_000 + "]", "there is a text of more than 20000 entries"),
        ("data: x\n" + "#" * MAX_BYTES, f"c.yaml: the file is larger than {MAX_BYTES} bytes"),
        ("data:\n\t- x", "c.yaml, line 2: this is not YAML: .*: indent by spaces, not by tabs."),
        ("data: 'x", "c.yaml, line 1: this is not YAML: .*quoted scalar"),
        ("data: [", "c.yaml, line 1: this is not YAML"),
        ("data: x: y", "c.yaml, line 1: this is not YAML: mapping values are not allowed here"),
        ('data: "\\UFFFFFFFF"', "c.yaml.*: this is not YAML"),
        ('data: "\\uD800"', "there is no file"),
        ("data: x\n\0", "c.yaml: this is not YAML: unacceptable character #x0000"),
        ("%YAML 7.0\n---\ndata: x", "this is not YAML"),
        ("%YAML 1." + "9" * 5000 + "\n---\ndata: x", "this is not YAML"),
        ("[data, x]", "c.yaml: it holds ['data', 'x'], must hold options"),
        ("just words", "c.yaml: it holds 'just words', must hold options"),
        ("data: x\n".encode("utf-16"), "c.yaml, line 1: the file is not text in UTF-8: save it as UTF-8."),
        ("data: x\n".encode("utf-32"), "c.yaml, line 1: the file is not text in UTF-8"),
        (b"data: x\noutput: \xe4\n", "c.yaml, line 2: the file is not text in UTF-8"),
        (bytes(range(256)) * 9, "c.yaml, line 2: the file is not text in UTF-8"),
    ],
    ids=lambda value: repr(value)[:30],
)
def test_45_what_a_configuration_has_no_need_of_is_refused(refused, text, message):
    said = refused("fit", text)
    assert all(part in said for part in message.split(".*"))
    assert len(said) < 300


@pytest.mark.parametrize("value", ["os.system", "subprocess.Popen", "canary.Canary", "canary.GMMBaseline", "canary"])
@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("fit", "model: {class_path: VALUE}"),
        ("fit", "model: VALUE"),
        ("fit", "model: {class_path: VALUE, init_args: {args: [touch, run]}}"),
        ("compare", "models: {a: {class_path: VALUE}}"),
        ("experiment", "controllers: {a: {class_path: VALUE}}"),
        ("experiment", "controllers: {a: {init_args: {covariance: VALUE}}}"),
        ("experiment", "controllers: {a: {init_args: {stiffness_law: {class_path: VALUE}}}}"),
    ],
)
def test_45_a_class_is_of_the_closed_table_and_nothing_is_imported(
    refused, command, text, value, tmp_path_factory, monkeypatch
):
    folder = tmp_path_factory.mktemp("modules")
    (folder / "canary.py").write_text("raise SystemExit('the canary was imported')\n")
    monkeypatch.syspath_prepend(folder)
    said = refused(command, text.replace("VALUE", value))
    assert f"== {value!r} is not a class that can be used here" in said
    assert "canary" not in sys.modules


@pytest.mark.parametrize(
    "arguments",
    [
        ["--model", "canary.Canary"],
        ["--model=canary.Canary"],
        ["--model", '{"class_path": "canary.Canary"}'],
        ["--model.class_path", "canary.Canary"],
        ["--model.help", "canary.Canary"],
        ["--model.help=canary.Canary"],
    ],
)
def test_45_nor_is_anything_imported_that_a_command_line_names(arguments, tmp_path, monkeypatch, capsys):
    (tmp_path / "canary.py").write_text("raise SystemExit('the canary was imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["fit", "--data", "x", *arguments]) == 2
    assert "== 'canary.Canary' is not a class that can be used here" in capsys.readouterr().err


@pytest.mark.parametrize("parameter", ["random_state", "prior", "device"])
def test_45_text_never_becomes_a_function(parameter):
    options, _ = parse("fit", ["--data", "x", "--model", "CholeskyCovRegressor", f"--model.{parameter}", "os.getcwd"])
    assert getattr(options.model, parameter) == "os.getcwd"  # which `fit` refuses


@pytest.mark.parametrize(
    ("name", "parameter", "text", "value"),
    [
        ("CholeskyCovRegressor", "prior", "1", 1.0),
        ("CholeskyCovRegressor", "prior", "1.5", 1.5),
        ("CholeskyCovRegressor", "prior", "[[1.0,0.0],[0.0,1.0]]", [[1.0, 0.0], [0.0, 1.0]]),
        ("HeteroscedasticGPRegressor", "prior", "[[2, 0], [0, 2]]", [[2.0, 0.0], [0.0, 2.0]]),
        ("WishartProcessRegressor", "prior", "null", None),
        ("CholeskyCovRegressor", "noise_scale", "1", 1.0),
        ("CholeskyCovRegressor", "length_scale", "2", 2.0),
        ("CholeskyCovRegressor", "length_scale", "[1, 2.5]", [1.0, 2.5]),
        ("HeteroscedasticGPRegressor", "period", "1", 1.0),
        ("HeteroscedasticGPRegressor", "period", "[1, .inf]", [1.0, np.inf]),
        ("WishartProcessRegressor", "df", "4", 4),
        ("WishartProcessRegressor", "df", "auto", "auto"),
        ("WishartProcessRegressor", "device", "0", "0"),
        ("WishartProcessRegressor", "random_state", "3", 3),
    ],
)
def test_45_a_command_line_says_what_a_file_says(name, parameter, text, value, tmp_path):
    file = tmp_path / "c.yaml"
    quoted = f"'{text}'" if isinstance(value, str) else text
    file.write_text(f"data: x\n{in_model(f'{{{parameter}: {quoted}}}', name).partition(chr(10))[2]}")
    forms = ["--config", str(file)], ["--data", "x", "--model", name, f"--model.{parameter}", text]
    for arguments in forms:
        found = getattr(parse("fit", arguments)[0].model, parameter)
        assert (found, type(found)) == (value, type(value)), arguments


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data"], "--data has no value: write --data VALUE."),
        (["--data", "--n_steps", "3"], "--data has no value"),
        (["data"], "there is 'data' where an option should stand: options begin with --."),
        (["-d", "x"], "there is '-d' where an option should stand"),
        (["--mod", "GMMBaseline"], "--mod is not an option of this command. Did you mean 'model'?"),
        (["--modle"], "--modle is not an option of this command. Did you mean 'model'?"),
        (["--model.tol", "soon"], "--model.tol is the text 'soon', must be a number."),
        (["--model.tol=010"], "--model.tol is the text '010', must be a number: write 10."),
        (["--model.init_args.tl", "1"], "--model.init_args.tl is not a parameter of HeteroscedasticGPRegressor. Did"),
        (["--model.tol.x", "1"], "--model.tol is a mapping, must be a number."),
        (["--model", "{class_path: GMMBaseline, init_args: {tol: no}}"], "--model.init_args.tol is the text 'no'"),
        (["--model", "!!python/name:os.system"], "--model, line 1: there is a tag"),
        (["--model", "[" * 3000], "--model, line 1: there is nesting of more than 50 levels"),
        (["--model.prior", "[[1, 0], [0, "], "--model.prior"),
        (["--model+", "x"], "--model+ is not an option of this command. Did you mean 'model'?"),
        (["--config"], "--config has no value"),
        (["--config", "nowhere.yaml"], "nowhere.yaml: the file cannot be read: No such file"),
        (["--config", "{data: x}"], "No such file"),
        (["--config", "."], ".: the file cannot be read: Is a directory"),
        (["--config", "a\0b"], "the file cannot be read"),
        (["--print_config=flags"], "--print_config=flags is not a flag of it. Known are skip_default."),
        (["--data.help", "x"], "--data.help == 'x' is not a class that can be used here."),
        ([], "data is missing: give --data"),
    ],
)
def test_45_a_command_line_is_held_to_the_same(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["fit", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"torch-pbd: {message}") or message in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_45_a_config_that_may_not_be_read_is_told(tmp_path, monkeypatch):
    def forbidden(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", forbidden)
    with pytest.raises(ConfigError, match=r"secret\.yaml: the file cannot be read: Permission denied"):
        read_yaml_file("secret.yaml")


SCALARS = {
    "1e-3": 1e-3,
    "1E5": 1e5,
    "1.2e3": 1.2e3,
    "+1.5e+3": 1.5e3,
    ".5": 0.5,
    "5.": 5.0,
    "-0.0": -0.0,
    "7": 7,
    "-7": -7,
    "0": 0,
    ".inf": np.inf,
    "-.INF": -np.inf,
    "true": True,
    "False": False,
    "null": None,
    "~": None,
    "": None,
    "12345678901234567890": 12345678901234567890,
}
TEXTS = ["no", "yes", "on", "off", "y", "n", "010", "0o10", "0x10", "0b1", "1_000", "1:20", "1:20.5", "2026-01-01"]
TEXTS += [
    "2026-01-01 10:00:00",
    "nan",
    "inf",
    "NaN",
    "tRue",
    "1e",
    "e3",
    ".",
    "+",
    "-",
    "1.2.3",
    "00",
    "=",
    "1 000",
    "\uff15",
]


@pytest.mark.parametrize("text", [*SCALARS, *TEXTS, "'1'", '"true"'])
def test_45_scalars_are_those_of_yaml_12(text):
    value = read_yaml(f"a: {text}", "here").content["a"] if text != "-" else read_yaml("'-'", "here").content
    expected = SCALARS.get(text, text.strip("'\""))
    assert value == expected
    assert type(value) is type(expected)


@pytest.mark.parametrize("text", ["", "\n\n", "# nothing\n", "---\n", "--- # nothing\n...\n", "\ufeff"])
def test_45_an_empty_file_gives_no_options(tmp_path, text):
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    assert read_yaml_file(str(tmp_path / "c.yaml")) == ({}, {})


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_45_line_ends_and_a_byte_order_mark_do_not_matter(tmp_path, newline, mark):
    text = mark + in_model("{tol: 1e-3}").replace("\n", newline)
    (tmp_path / "c.yaml").write_bytes(text.encode())
    document = read_yaml_file(str(tmp_path / "c.yaml"))
    assert document.content["model"] == {"class_path": "GMMBaseline", "init_args": {"tol": 1e-3}}
    assert document.lines["model", "init_args", "tol"] == 4


def test_45_a_pipe_may_be_a_config(tmp_path):
    program = "from torch_pbd.cli.main import main; import sys; sys.exit(main(sys.argv[1:]))"
    arguments = ["fit", "--config", "/dev/stdin", "--print_config=skip_default"]
    shown = subprocess.run(
        [sys.executable, "-c", program, *arguments], input="data: x\nalign: dtw\n", capture_output=True, text=True
    )
    assert (shown.stdout, shown.stderr, shown.returncode) == ("data: x\nalign: dtw\n", "", 0)


def test_45_variables_of_the_environment_set_no_option(monkeypatch):
    for name in ("TORCH_PBD_FIT__N_STEPS", "TORCH_PBD_N_STEPS", "FIT_N_STEPS", "N_STEPS", "CLI_N_STEPS"):
        monkeypatch.setenv(name, "7")
    monkeypatch.setenv("JSONARGPARSE_DEFAULT_ENV", "true")
    monkeypatch.setenv("JSONARGPARSE_DEBUG", "true")
    assert parse("fit", ["--data", "x"])[0].n_steps is None


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_the_configs_of_this_checkout_are_read_and_given_back(config, tmp_path):
    command = COMMAND_OF.get(config.stem, "compare")
    first, text = parse(command, ["--config", str(config)])
    (tmp_path / "again.yaml").write_text(text)
    second, again = parse(command, ["--config", str(tmp_path / "again.yaml")])
    assert text == again
    assert repr(first) == repr(second)
    written = yaml.safe_load(text)
    assert set(yaml.safe_load(config.read_text())) <= set(written)
    assert parse(command, [])[1] != text


@pytest.mark.parametrize("config", [None, *CONFIGS], ids=lambda path: path.stem if path else "none")
def test_the_papers_configurations_name_the_papers_regressor_and_all_others_take_the_default(config):
    command = COMMAND_OF.get(config.stem, "compare") if config else "experiment"
    options, _ = parse(command, ["--config", str(config)] if config else [])
    if command == "compare":
        taken = [type(model) for model in options.models.values()]
    else:
        # What a controller takes without one is in tests/control/test_controller.py.
        taken = [type(each.covariance or HeteroscedasticGPRegressor()) for each in options.controllers.values()]
    if config is None or config.parent.name != "paper":
        assert taken[0] is HeteroscedasticGPRegressor
    elif command == "experiment":
        assert taken == 3 * [CholeskyCovRegressor] + [HeteroscedasticGPRegressor]
    else:
        assert HeteroscedasticGPRegressor not in taken


@pytest.mark.parametrize(
    "model", [HeteroscedasticGPRegressor, CholeskyCovRegressor, WishartProcessRegressor, GMMBaseline]
)
def test_a_model_named_anew_has_its_own_defaults(model, tmp_path):
    """Those of the model that was there before, the default or one of a file, are not its own."""
    (tmp_path / "c.yaml").write_text("model: {class_path: CholeskyCovRegressor, init_args: {max_iter: 7, tol: 0.5}}\n")
    for before in ([], ["--config", str(tmp_path / "c.yaml")]):
        for named in (["--model", model.__name__], ["--model", f"{{class_path: torch_pbd.{model.__name__}}}"]):
            if before and model is CholeskyCovRegressor:
                continue
            options, _ = parse("fit", ["--data", "x", *before, *named])
            assert type(options.model) is model
            assert options.model.get_params() == model().get_params()


def test_what_is_given_later_wins_and_the_rest_stays(tmp_path):
    (tmp_path / "a.yaml").write_text("data: a\nmodel: {class_path: GMMBaseline, init_args: {tol: 0.5, max_iter: 7}}\n")
    (tmp_path / "b.yaml").write_text("n_steps: 9\nmodel: {init_args: {max_iter: 8}}\n")
    files = ["--config", str(tmp_path / "a.yaml"), "--config", str(tmp_path / "b.yaml")]
    options, _ = parse("fit", [*files, "--model", "GMMBaseline", "--model.n_restarts", "3", "--data", "2026-01-01"])
    assert (options.data, options.n_steps) == ("2026-01-01", 9)
    assert options.model.get_params() == GMMBaseline(tol=0.5, max_iter=8, n_restarts=3).get_params()


def test_entries_are_added_one_by_one_on_the_command_line():
    law = ["--controllers.mine.stiffness_law.stiffness_max", "4e2", "--controllers.mine.covariance", "GMMBaseline"]
    more = ["--controllers.mine.covariance.n_components", "2", "--controllers.other.mass=2"]
    controllers = parse("experiment", [*law, *more])[0].controllers
    assert list(controllers) == ["recommended", "mine", "other"]
    assert controllers["mine"].stiffness_law.stiffness_max == 400.0
    assert controllers["mine"].covariance.n_components == 2
    assert controllers["other"].mass == 2.0


@pytest.mark.parametrize("command", COMMANDS)
def test_what_print_config_shows_can_be_read(command, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--print_config"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    (tmp_path / "c.yaml").write_text(shown)
    data = ["--data", "x"] if command in ("fit", "inspect") else []
    assert parse(command, ["--config", str(tmp_path / "c.yaml"), *data])[1] == parse(command, data)[1]


def test_print_config_of_what_was_given_alone(capsys):
    arguments = ["--model", "GMMBaseline", "--model.tol", "1e-3"]
    with pytest.raises(SystemExit):
        main(["fit", *arguments, "--print_config=skip_default"])
    shown = yaml.safe_load(capsys.readouterr().out)
    assert shown == {"model": {"class_path": "torch_pbd.GMMBaseline", "init_args": {"tol": 0.001}}}
    with pytest.raises(ConfigError, match="tol is the text"):
        parse("fit", ["--print_config", "--model.tol", "soon"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit", "--model.help", "GMMBaseline"], "n_components: "),
        (["compare", "--models.help=WishartProcessRegressor"], "df: "),
        (["experiment", "--controllers.help", "DMPController"], "gate: "),
        (["experiment", "--controllers.mine.covariance.help", "GMMBaseline"], "reg_covar: "),
    ],
)
def test_help_of_a_class(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    assert words in capsys.readouterr().out


def messages(path, text):
    """What the commands say of a config: nothing, or why it cannot be used."""
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
    for command in ("fit", "experiment"):
        try:
            parse(command, ["--config", str(path)])
        except ConfigError as error:
            yield str(error)


BOUNDED = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
PIECES = st.sampled_from(
    [
        *"[]{}:,-?&*!|>'\"%@`#~=. \n\t\r\0",
        "<<: ",
        "!!",
        "---\n",
        "...\n",
        "&a ",
        "*a",
        "\n  ",
        "1e-3",
        ".nan",
        "\ufeff",
        "model",
        "data",
        "init_args",
        "class_path",
        "GMMBaseline",
        "controllers",
        "covariance",
        "é",
        "\u2028",
        "\\",
    ]
)


@BOUNDED
@given(text=st.text(max_size=200) | st.lists(PIECES, max_size=40).map("".join) | st.binary(max_size=200))
@example(text="- " * 100_000)
@example(text="{" * 100_000)
@example(text="a: " * 100_000)
@example(text="a: 'b\n" * 10_000)
@example(text="&a [" * 3000)
@example(text="!" * 100_000)
@example(text="|\n" + " " * 100_000)
@example(text="%" + "a" * 100_000)
def test_45_any_text_is_accepted_or_refused(tmp_path, text):
    for message in messages(tmp_path / "c.yaml", text):
        assert message.isprintable()
        assert len(message) < 1000


@BOUNDED
@given(data=st.data())
def test_45_any_change_of_a_config_is_accepted_or_refused(tmp_path, data):
    text = data.draw(st.sampled_from(CONFIGS)).read_text()
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(text)))
        stop = min(len(text), start + data.draw(st.integers(0, 30)))
        text = text[:start] + data.draw(st.lists(PIECES, max_size=5).map("".join) | st.text(max_size=9)) + text[stop:]
    for message in messages(tmp_path / "c.yaml", text):
        assert message.isprintable()
        assert len(message) < 1000
