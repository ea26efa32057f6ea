"""The experiment with a tool that turns: what it prints is what the runs show."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.base import clone

from torch_pbd import Demonstrations, DMPController, GMMBaseline
from torch_pbd.cli.main import main
from torch_pbd.control import RotationLimits, Schedule, StiffnessLaw
from torch_pbd.data import make_pose_demonstrations, pose_covariance, pose_mean
from torch_pbd.exceptions import ConfigError
from torch_pbd.experiments.pushes import damping_ratio, push, push_rows, with_panda
from torch_pbd.experiments.robot import pose_covariances, run_robot
from torch_pbd.experiments.run_folder import RunFolder
from torch_pbd.plotting.style import POSITION, ROTATION

LAW = StiffnessLaw(stiffness_min=100.0, stiffness_max=1500.0, rotation=RotationLimits(2.0, 60.0))


@pytest.fixture(scope="module")
def recorded():
    return make_pose_demonstrations(8, duration=2.0, rate=25.0, random_state=0)


@pytest.fixture(scope="module")
def controller():
    return DMPController(GMMBaseline(n_components=2), stiffness_law=LAW, n_steps=50)


@pytest.fixture(scope="module")
def run(controller, recorded):
    return push(controller.fit(recorded), rate=200.0, peak=12.0)


@pytest.fixture(scope="module")
def planned():
    """A schedule along the mean of the made task, with gains of 1 kg and 1 kg m2."""
    phase = np.linspace(0.0, 1.0, 81)
    position, orientation = pose_mean(phase)
    gains = [np.tile(np.diag([a] * 3 + [b] * 3), (81, 1, 1)) for a, b in ((400.0, 25.0), (40.0, 10.0))]
    rows = (4.0 * phase, position, np.zeros((81, 6)), *gains, pose_covariance(phase), np.zeros(81))
    return Schedule(*rows, orientation=orientation)


def test_pushes_are_in_the_axes_that_the_tool_has_in_their_middle(run):
    n = len(run.schedule)
    for rollouts, outputs, others, peak in (
        (run.pushes["force"], slice(3), slice(3, 6), 12.0),
        (run.pushes["torque"], slice(3, 6), slice(3), 1.2),
    ):
        for axis, rollout in enumerate(rollouts):
            for middle in (round(0.2 * (n - 1)), round(0.8 * (n - 1))):
                turn = Rotation.from_quat(run.schedule.orientation[middle], scalar_first=True).as_matrix()
                np.testing.assert_allclose(rollout.force[middle, outputs], peak * turn[:, axis], rtol=1e-12, atol=1e-12)
            assert not rollout.force[:, others].any()
    assert not run.unpushed.force.any()


def test_the_table_has_what_the_runs_show(run):
    turns = Rotation.from_quat(run.schedule.orientation, scalar_first=True).as_matrix()
    half, late = len(turns) // 2, round(0.8 * (len(turns) - 1))
    for kind, rollouts, block, scale in (
        (POSITION, run.pushes["force"], slice(3), 1e3),
        (ROTATION, run.pushes["torque"], slice(3, 6), 180 / np.pi),
    ):
        for axis, row in enumerate(push_rows("mine", run, kind)):
            own = turns[:, :, axis]
            moved = np.abs(((rollouts[axis].deviation - run.unpushed.deviation)[:, block] * own).sum(axis=1)) * scale
            assert row["early"] == pytest.approx(moved[:half].max(), rel=1e-12)
            assert row["late"] == pytest.approx(moved[half:].max(), rel=1e-12)
            stiffness = own[late] @ run.schedule.stiffness[late, block, block] @ own[late]
            assert row["K late"] == pytest.approx(stiffness, rel=1e-12)
            assert row["axis"] == f"tool {'xyz'[axis]}"
    # A peg in its hole may turn about its axis, and not about the others.
    about = [row["late"] for row in push_rows("mine", run, ROTATION)]
    assert about[2] > 2.0 * max(about[:2])


@pytest.mark.parametrize("ratio", [0.3, 0.7])
def test_the_damping_ratio_is_that_of_the_inertia(planned, rng, ratio):
    root = rng.normal(size=(6, 6))
    own = planned.with_inertia(root @ root.T + np.eye(6), damping_ratio=ratio)
    assert damping_ratio(own, own.damping) == pytest.approx(ratio, rel=1e-9)
    assert damping_ratio(planned, planned.damping) == pytest.approx(1.0, abs=1e-6)  # a double root


def test_a_schedule_gets_the_inertia_of_the_arm_and_its_damping(planned):
    pytest.importorskip("mujoco")
    from torch_pbd.robots import HOME, inverse_kinematics, operational_inertia, panda

    own = with_panda(planned)
    arm, row = panda(), 40
    pose = planned.position[[row]], planned.orientation[[row]]
    inertia = operational_inertia(arm, inverse_kinematics(arm, *pose, "tool", start=HOME), "tool")[0]
    # Rows of the arm are 20 ms apart, between which it is linear.
    np.testing.assert_allclose(own.mass[row], inertia, rtol=0, atol=1e-3 * np.abs(inertia).max())
    assert damping_ratio(own, own.damping) == pytest.approx(1.0, abs=1e-6)
    assert damping_ratio(own, planned.damping) < 0.6


def test_empirical_covariances_are_those_of_the_law():
    many = make_pose_demonstrations(300, duration=1.0, rate=20.0, timing=0.0, random_state=0)
    phase, covariance = pose_covariances(many)
    roots = np.linalg.inv(np.linalg.cholesky(pose_covariance(phase)))
    white = roots @ covariance @ roots.swapaxes(1, 2)
    # Variances are within 4 sqrt(2 / 300), but for what is interpolated linearly between samples.
    np.testing.assert_allclose(white, np.broadcast_to(np.eye(6), white.shape), atol=0.4)


def test_a_run_leaves_its_tables_figures_schedules_and_models(controller, recorded, tmp_path):
    folder = RunFolder(tmp_path, {})
    text = run_robot({"a b": controller}, recorded, folder, rate=100.0)
    assert "a b         tool z" in text
    assert "a b: a movement of" in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "figure6_task.png", "a_b_figure7_variability.png", "a_b_figure8_pushes.png",
    }  # fmt: skip
    assert Schedule.load(tmp_path / "schedule" / "a_b.npz").orientation.shape[1] == 4
    assert (tmp_path / "model" / "a_b_controller.safetensors").is_file()
    assert len((tmp_path / "metrics.csv").read_text().splitlines()) == 1 + 6
    still = np.tile([0.0, 1.0, 0.0, 0.0, 0.0], (2, 2, 1))
    flat = Demonstrations([0.0, 1.0], still, names=("x", "qw", "qx", "qy", "qz"), rotation=("qw", "qx", "qy", "qz"))
    with pytest.raises(ConfigError, match="a pose has three positions and a rotation, not the outputs"):
        run_robot({"a": controller}, flat, folder)


def test_without_pushes_there_is_no_ratio_and_the_mass_is_the_controllers(controller, recorded, tmp_path):
    heavy = clone(controller).set_params(mass=3.0)
    text = run_robot({"a": heavy}, recorded, RunFolder(tmp_path, {}), peak=0.0, torque=0.0, rate=100.0)
    assert text.split("\n")[3].split()[3:5] == ["0", "0"]
    assert " s; of 3 kg and 3 kg m^2\n" in text


def test_without_mujoco_the_extra_is_told_before_anything_is_learned(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert main(["experiment", "--task", "peg", "--output", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        "torch-pbd: arm: a Panda needs mujoco, which is not installed: pip install 'torch_pbd[robot]'. "
    )
    assert said.endswith("--arm none.\n")
    assert not list(tmp_path.rglob("*.safetensors"))


@pytest.mark.slow
def test_the_experiment_of_poses_runs_from_its_configuration(tmp_path, capsys):
    pytest.importorskip("mujoco")
    config = ["--config", "configs/pose.yaml", "--rate", "250", "--output", str(tmp_path)]
    assert main(["experiment", *config]) == 0
    text = capsys.readouterr().out
    for words in (
        "12 N along and 1.2 Nm about each axis of the tool",
        "[Nm/rad]",
        "precision   tool z",
        "made for 1 kg",
    ):
        assert words in text


@pytest.mark.slow
def test_an_arm_in_mujoco_is_pushed_as_far_as_its_plant():
    pytest.importorskip("mujoco")
    from torch_pbd.robots import HOME, inverse_kinematics, mujoco, panda

    law = StiffnessLaw(stiffness_min=300.0, stiffness_max=1500.0, rotation=RotationLimits(5.0, 60.0))
    controller = DMPController(GMMBaseline(n_components=3), stiffness_law=law)
    run = push(controller.fit(make_pose_demonstrations(random_state=0)), peak=12.0, arm="panda")
    schedule, model = run.schedule, panda()
    joints = inverse_kinematics(model, schedule.position, schedule.orientation, "tool", start=HOME)
    still = mujoco.run(model, schedule, joints).deviation
    for kind, rollout, axis in ((POSITION, run.pushes["force"][1], 1), (ROTATION, run.pushes["torque"][2], 2)):
        moved = mujoco.run(model, schedule, joints, wrench=rollout.force).deviation - still
        own = np.abs(kind.scale * run.along(moved, kind)[:, axis])
        # The plant is linear in rotations, and has the inertia of the arm where it should be.
        assert own.max() == pytest.approx(np.abs(run.moved(kind)[:, axis]).max(), rel=0.02)
