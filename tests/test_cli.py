import csv
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import yaml

import torch_pbd
from torch_pbd.cli.main import main
from torch_pbd.control import Schedule
from torch_pbd.data import Demonstrations, make_tunnel_demonstrations


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "recording.csv"
    torch_pbd.save_demonstrations(make_tunnel_demonstrations(5, rate=4.0, random_state=0), path)
    return path


@pytest.fixture
def empty_figures(monkeypatch):
    """Figures take most of the time of a short run."""
    monkeypatch.setattr("torch_pbd.experiments.comparison.figure_of", lambda *_: plt.figure())


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["fit", "--help"],
        ["inspect", "--help"],
        ["compare", "--help"],
        ["demo", "--help"],
        ["experiment", "--help"],
        ["help"],
        ["help", "fit"],
    ],
)
def test_help_does_not_wait_for_torch(arguments):
    program = (
        "import sys\nfrom torch_pbd.cli.main import main\n"
        f"try:\n    main({arguments!r})\nexcept SystemExit:\n    pass\n"
        "assert not {'torch', 'sklearn', 'matplotlib'} & set(sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "torch-pbd" in shown.stdout


def test_fit_leaves_a_folder_from_which_the_run_can_be_repeated(recording, tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    arguments = ["fit", "--data", str(recording), "--model", "CholeskyCovRegressor", "--model.length_scale", "2e0"]
    assert main([*arguments, "--output", str(first)]) == 0
    assert "5 demonstrations of 41 samples, 2 outputs (x, y), aligned" in capsys.readouterr().out
    assert main(["fit", "--config", str(first / "config.yaml"), "--output", str(second)]) == 0
    models = [torch_pbd.load(folder / "model" / "choleskycovregressor.safetensors") for folder in (first, second)]
    assert models[0].length_scale == 2.0
    query = np.linspace(0.0, 10.0, 7)[:, None]
    np.testing.assert_array_equal(models[0].predict_cov(query), models[1].predict_cov(query))
    assert (first / "figures" / "choleskycovregressor.png").stat().st_size > 10_000
    assert json.loads((first / "env.json").read_text())["torch_pbd"] == torch_pbd.__version__


@pytest.mark.parametrize(
    ("name", "found"),
    [("HGP", "HeteroscedasticGPRegressor"), ("CD", "CholeskyCovRegressor"), ("GMM 8", "GMMBaseline")],
)
def test_models_have_the_names_that_tables_print(name, found, capsys):
    with pytest.raises(SystemExit):
        main(["fit", "--data", "x.csv", "--model", name, "--print_config=skip_default"])
    shown = yaml.safe_load(capsys.readouterr().out).get("model", {"class_path": f"torch_pbd.{found}"})
    assert shown["class_path"] == f"torch_pbd.{found}"
    assert shown.get("init_args", {}).get("n_components") == (8 if name == "GMM 8" else None)


@pytest.mark.usefixtures("empty_figures")
def test_where_one_of_two_is_left_out_models_of_movements_are_not_compared(tmp_path, capsys):
    path = tmp_path / "two.csv"
    torch_pbd.save_demonstrations(make_tunnel_demonstrations(2, rate=4.0, random_state=0), path)
    arguments = ["compare", "--data", str(path), "--output", str(tmp_path / "out"), "--models"]
    assert main([*arguments, '{"whole": "ProMPBaseline"}']) == 2
    assert "how whole movements differ is not seen in one" in capsys.readouterr().err
    assert main([*arguments, '{"whole": "ProMPBaseline", "rows": "GMMBaseline"}']) == 0
    told, _, table = capsys.readouterr().out.partition("joint LL:")[0].partition("\n\n")[2].partition("\n\n")
    words = "without whole, as models of whole movements cannot be compared here: one left out leaves one"
    assert " ".join(told.split()).startswith(words)
    assert max(map(len, told.splitlines())) <= 80
    assert table
    assert "whole" not in table
    arguments = ["compare", "--n_seeds", "1", "--readings", "[bell]", *arguments[3:], "{W: ProMPBaseline, G: GMM 5}"]
    assert main(arguments) == 0
    words = "without W, as models of whole movements cannot be compared here: the simu"
    assert words in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", ["TrajectoryRegressor", "ProMPBaseline", "KMPBaseline"])
def test_models_of_movements_are_fitted_and_load(name, recording, tmp_path, capsys):
    config = tmp_path / "fit.yaml"
    own = "init_args: {regressor: {class_path: GMMBaseline, init_args: {n_components: 3}}}" if name[0] != "P" else ""
    config.write_text(f"data: {recording}\noutput: {tmp_path / 'out'}\nmodel:\n  class_path: {name}\n  {own}\n")
    assert main(["fit", "--config", str(config)]) == 0
    assert f"{name} learned 5 movements; joint log-likelihood " in capsys.readouterr().out
    model = torch_pbd.load(tmp_path / "out" / "model" / f"{name.lower()}.safetensors")
    X, y, groups = torch_pbd.load_demonstrations(recording).stack()
    with (tmp_path / "out" / "metrics.csv").open() as file:
        assert float(next(csv.DictReader(file))["LL"]) == pytest.approx(model.score(X, y, groups=groups))
    if own:
        assert model.regressor_.n_components == 3


def test_a_controller_of_a_config_bends_by_a_model_of_movements(recording, tmp_path):
    config = tmp_path / "robot.yaml"
    config.write_text(
        "controllers:\n  mine:\n    init_args:\n      covariance: {class_path: TrajectoryRegressor, init_args:"
        " {regressor: {class_path: GMMBaseline}}}\n"
    )
    arguments = ["--data", str(recording), "--rate", "100", "--output", str(tmp_path / "out")]
    assert main(["experiment", "--config", str(config), *arguments]) == 0
    controller = torch_pbd.load(tmp_path / "out" / "model" / "mine_controller.safetensors")
    point = controller.predict([[5.0]])[0] + [0.01, 0.0]
    schedule = controller.schedule(100.0, via=[(5.0, point)])
    np.testing.assert_allclose(schedule.position[500], point, atol=1e-6)


@pytest.mark.usefixtures("empty_figures")
def test_compare_reports_every_model_and_every_fold(recording, tmp_path, capsys):
    config = tmp_path / "compare.yaml"
    config.write_text(
        f"data: {recording}\nmax_folds: 3\noutput: {tmp_path / 'out'}\nmodels:\n"
        "  mine: {class_path: CholeskyCovRegressor, init_args: {noise_scale: 1e-4}}\n"
        "  mixture: {class_path: torch_pbd.GMMBaseline, init_args: {n_components: 2}}\n"
        "  whole: {class_path: TrajectoryRegressor, init_args: {regressor:"
        " {class_path: GMMBaseline, init_args: {n_components: 2}}}}\n"
    )
    assert main(["compare", "--config", str(config)]) == 0
    shown = capsys.readouterr().out
    for best in ("held-out LL", "joint LL"):
        assert any(f"\nbest {best}: {name}, " in shown for name in ("mine", "mixture", "whole"))
    assert "error to truth" not in shown  # which is not known of recordings
    assert max(map(len, shown[: shown.index("report:")].splitlines())) <= 80
    with (tmp_path / "out" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["model"] for row in rows] == ["mine", "mixture", "whole"]
    # The same marginals, with and without the correlation along the movement.
    assert rows[2]["held-out LL"] == rows[1]["held-out LL"]
    assert float(rows[2]["joint LL"]) > float(rows[1]["joint LL"])
    folds = [float(rows[0][f"LL {i}"]) for i in (1, 2, 3)]
    assert float(rows[0]["held-out LL"]) == pytest.approx(np.mean(folds))
    assert torch_pbd.load(tmp_path / "out" / "model" / "mine.safetensors").noise_scale == 1e-4


def test_without_folds_the_legend_is_of_the_fit_alone(recording, tmp_path, capsys):
    arguments = ["--data", str(recording), "--models", "{A: GMM 5, B: GMM 8}", "--output", str(tmp_path / "out")]
    assert main(["compare", *arguments, "--max_folds", "0"]) == 0
    shown = capsys.readouterr().out
    assert "least eig.: smallest" in shown
    assert "MSE: squared" in shown
    assert not {"best", "held-out", "joint", "left-out"} & set(shown.split("report:")[0].split())


def test_compare_without_data_is_table_1(tmp_path, capsys):
    arguments = ["--readings", "[printed]", "--n_seeds", "1", "--n_draws", "10", "--max_folds", "1"]
    models = '{"CD": {"class_path": "CholeskyCovRegressor", "init_args": {"noise_scale": 0.0, "prior": "paper"}}}'
    assert main(["compare", *arguments, "--models", models, "--output", str(tmp_path)]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("printed"))
    assert float(row.split()[2]) <= 1e-12
    assert row.split()[3] == "3.54e-13"  # the paper's, beside ours
    assert (tmp_path / "figures" / "cd.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["comparre"], "'comparre' is not a command. Did you mean 'compare'"),
        (["fit"], "data"),
        (["fit", "--data", "missing.npz"], "no file 'missing.npz'"),
        (["fit", "--data", "x.npz", "--modle", "GMMBaseline"], "Did you mean 'model'"),
        (["fit", "--data", "x.npz", "--model", "CholeskyCovRegresor"], "Did you mean 'CholeskyCovRegressor'"),
        (
            ["fit", "--data", "x.npz", "--model", "GMMBaseline", "--model.n_component", "3"],
            "Did you mean 'n_components'",
        ),
        (["fit", "--data", "x.npz", "--model", "GMMBaseline", "--model.tol", "soon"], "soon"),
        (["fit", "--data", "x.npz", "--model", "KMPBaseline", "--model.regressor", "ProMPBaseline"], "not a class"),
        (
            ["fit", "--data", "x.npz", "--n_steps", "1"],
            "--n_steps is the number 1, must be a whole number of at least 2",
        ),
        (
            ["fit", "--data", "x.npz", "--model", "CD", "--model.noise_scale", "-1"],
            "model: noise_scale is -1.0, must be",
        ),
        (["compare", "--models", '{"mine": "ProMPBaseline"}'], "models: there are only such of whole movements"),
        (
            [
                "experiment",
                "--controllers",
                '{"mine": {"class_path": "DMPController", "init_args": {"gatee": "none"}}}',
            ],
            "Did you mean 'gate'",
        ),
    ],
)
def test_what_cannot_be_used_is_one_line_and_exit_code_2(arguments, message, capsys):
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert message in shown.err
    assert shown.err.count("\n") == 1
    assert shown.out == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("data: a.npz\ndata: b.npz\n", "twice"),
        ("data: a.npz\nouptut: x\n", "Did you mean 'output'"),
        ("data: [\n", "config"),
        ("data: !!python/object/apply:os.system ['true']\n", "config"),
    ],
)
def test_a_config_that_cannot_be_used_is_one_line_and_exit_code_2(text, message, tmp_path, capsys):
    config = tmp_path / "config.yaml"
    config.write_text(text)
    assert main(["fit", "--config", str(config)]) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1


def test_a_failed_fit_is_one_line_and_exit_code_1(tmp_path, capsys):
    path = tmp_path / "one.npz"
    torch_pbd.save_demonstrations(Demonstrations(np.arange(9.0), np.random.default_rng(0).normal(size=(1, 9, 1))), path)
    model = ["--model", "WishartProcessRegressor", "--model.objective", "mse"]
    assert main(["fit", "--data", str(path), *model, "--output", str(tmp_path / "out")]) == 1
    notes, complaint = capsys.readouterr().err.strip().splitlines()
    assert "one demonstration" in notes
    assert "needs >= 2 demonstrations" in complaint


def test_the_experiment_of_the_paper_gives_figure_8(tmp_path, capsys):
    config = Path(__file__).parents[1] / "configs" / "paper" / "robot.yaml"
    assert main(["experiment", "--config", str(config), "--rate", "200", "--output", str(tmp_path)]) == 0
    assert "Did" not in capsys.readouterr().err
    with (tmp_path / "metrics.csv").open() as file:
        rows = {row["controller"]: row for row in csv.DictReader(file)}
    ratio = {name: float(row["ratio"]) for name, row in rows.items()}
    assert ratio["Table II as printed"] < 1.2  # all variability is above its bounds: soft throughout
    assert 15.0 <= ratio["Table II as variances, over time"] <= 25.0
    for name in ("Table II as variances, over time", "recommended"):
        assert float(rows[name]["K x early"]) == pytest.approx(50.0)
        assert float(rows[name]["K x late"]) > 800.0
        assert float(rows[name]["K y early"]) > 999.0
    assert (tmp_path / "figures" / "figure5_framework.png").is_file()


def test_an_experiment_on_a_file_takes_its_covariance_from_the_config(recording, tmp_path, capsys):
    config = tmp_path / "robot.yaml"
    config.write_text(
        "controllers:\n  mine:\n    class_path: DMPController\n    init_args:\n      mass: 2.0\n"
        "      covariance: {class_path: GMMBaseline, init_args: {n_components: 2}}\n"
        "      stiffness_law: {stiffness_max: 4e2}\n"
    )
    arguments = ["--data", str(recording), "--rate", "100", "--output", str(tmp_path / "out")]
    assert main(["experiment", "--config", str(config), *arguments]) == 0
    assert "stability of the admittance at 2 kg" in capsys.readouterr().out
    schedule = Schedule.load(tmp_path / "out" / "schedule" / "mine.npz")
    assert schedule.stiffness_limits == (50.0, 400.0)
    assert "GMMBaseline" in schedule.provenance["covariance"]


def test_joints_are_pushed_by_torques(tmp_path, capsys, monkeypatch):
    path = tmp_path / "joints.npz"
    turned = np.random.default_rng(0).normal(size=(3, 9, 2))
    torch_pbd.save_demonstrations(Demonstrations(np.arange(9.0), turned, names=["a", "b"], units="rad"), path)
    monkeypatch.setattr("torch_pbd.experiments.robot.run_robot", lambda *args, **options: "")
    assert main(["experiment", "--data", str(path), "--output", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "pushes of 5 Nm about a,\nat 20 % and 80 % of the movement; K is the stiffness there, Nm/rad\n" in shown


@pytest.mark.parametrize("name", ["push", "torque"])
def test_a_push_against_its_axis_is_refused(name, capsys):
    assert main(["experiment", f"--{name}", "-3"]) == 2
    assert f"--{name} is the number -3, must be a number from 0 to 1e+06" in capsys.readouterr().err


@pytest.mark.parametrize(("task", "n_demos"), [("tunnel", 6), ("peg", 8)])
def test_made_demonstrations_are_enough_for_their_outputs(task, n_demos, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("torch_pbd.experiments.robot.run_robot", lambda *args, **options: "")
    assert main(["experiment", "--task", task, "--arm", "none", "--output", str(tmp_path)]) == 0
    assert f"{task} task: {n_demos} demonstrations" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "told"), [("kuka_cube_pick", "cut while moving"), ("letter_G", "which is no known length")]
)
def test_recorded_skills_are_pushed(name, told, recordings, tmp_path, capsys):
    config = Path(__file__).parents[1] / "configs" / "robot.yaml"
    data = ["--data", str(recordings / f"{name}.npz")]
    assert main(["experiment", "--config", str(config), *data, "--output", str(tmp_path)]) == 0
    remarks = capsys.readouterr().err
    assert told in remarks
    assert len(remarks.splitlines()) == 1  # for all controllers
    with (tmp_path / "metrics.csv").open() as file:
        for row in csv.DictReader(file):
            assert row["stable"] == "yes"
            assert 50.0 <= float(row["K x early"]) <= 1000.0


@pytest.mark.slow
def test_the_demo_runs(tmp_path, capsys):
    assert main(["demo", "--output", str(tmp_path)]) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "95 % of fresh: " in " ".join(shown.out.split())
    robot = {"hgp_figure6_task.png", "hgp_figure7_variability.png", "hgp_figure8_pushes.png"}
    figures = {path.name for path in (tmp_path / "figures").iterdir()}
    assert figures == {"hgp.png", "cd.png", "wp.png", "gmm_5.png", "tunnel.png"} | robot
    models = {path.stem for path in (tmp_path / "model").iterdir()}
    assert models == {"hgp", "cd", "wp", "gmm_5", "hgp_controller"}
    assert max(map(len, shown.out.replace(str(tmp_path), "").splitlines())) <= 80
    assert Schedule.load(tmp_path / "schedule" / "hgp.npz").duration == 10.0
    with (tmp_path / "pushes.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert float(row["early [mm]"]) > 5.0 * float(row["late [mm]"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["letter_G", "pen_a", "kuka_cube_pick", "snooker_skilled", "adroit_door_palm"])
def test_recordings_are_compared_without_a_warning(name, recordings, tmp_path, capsys):
    assert (
        main(["compare", "--data", str(recordings / f"{name}.npz"), "--max_folds", "1", "--output", str(tmp_path)]) == 0
    )
    assert capsys.readouterr().err == ""
    with (tmp_path / "metrics.csv").open() as file:
        for row in csv.DictReader(file):
            assert float(row["least eig."]) > 0
            assert np.isfinite(float(row["held-out LL"]))
