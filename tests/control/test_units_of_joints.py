"""Schedules of joint angles are in rad, Nm and Nm/rad wherever they are shown."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from torch_pbd.control import AdmittancePlant, RealTimeAdmittance, Schedule, simulate, simulate_many
from torch_pbd.data.units import ANGLES, LENGTHS


@pytest.fixture(scope="module")
def joints():
    """Two joints at rest for two seconds, 100 Nm/rad."""
    still, eye = np.zeros((201, 2)), np.tile(np.eye(2), (201, 1, 1))
    rows = (np.linspace(0.0, 2.0, 201), still, still, 100.0 * eye, 20.0 * eye, 1e-4 * eye, np.zeros(201))
    return Schedule(*rows, names=["shoulder", "elbow"], units="rad")


@pytest.fixture
def run(joints):
    return simulate(joints, np.tile([5.0, 0.0], (201, 1)), plant=AdmittancePlant())


def test_a_run_is_in_radians(run):
    assert run.units == run.numpy().units == "rad"
    assert repr(run).endswith("deviation up to 0.05 rad)")  # 5 Nm on 100 Nm/rad


def test_pushes_turn_joints_by_degrees(joints):
    summary = simulate_many(joints, 3, peak=1.0, random_state=0)
    peak = np.degrees(np.median(summary.peak_deviation))
    assert f"/{peak:.3g}/" in repr(summary)
    assert " degrees at " in repr(summary)
    assert " mm " not in repr(summary)


def test_figures_say_about_which_joint_and_in_which_unit(joints, run):
    *_, stiffness = joints.plot()
    moved, pushed, stiff = run.plot(names=joints.names)
    assert [ax.get_ylabel() for ax in (stiffness, stiff)] == ["stiffness [Nm/rad]"] * 2
    assert [ax.get_ylabel() for ax in (moved, pushed)] == ["deviation [rad]", "external torque [Nm]"]
    assert moved.lines[0].get_label() == stiffness.lines[0].get_label() == "about shoulder"
    np.testing.assert_array_equal(moved.lines[0].get_ydata(), run.deviation[:, 0])
    plt.close("all")


@pytest.mark.parametrize("move", [simulate, simulate_many, RealTimeAdmittance])
def test_forces_move_what_is_in_metres_or_radians(joints, move):
    for units in {*LENGTHS, *ANGLES} - {"m", "rad"}:
        with pytest.raises(ValueError, match=f"units of schedule is '{units}', must be 'm' or 'rad'"):
            move(replace(joints, units=units))
    for units in ("rad", "px", None):
        move(replace(joints, units=units))
