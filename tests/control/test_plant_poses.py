"""The simulated robot with orientations and inertia: scipy on SO(3), scipy's exponential, and what stays as it was."""

import re

import numpy as np
import pytest
import scipy.linalg
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from torch_pbd import rotations
from torch_pbd.control.filters import EnergyTank, RateLimit, lyapunov_matrix
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.sensor import ForceSensor, PositionLoop
from torch_pbd.control.simulation.ticks import admittance_rate
from torch_pbd.control.simulation.walls import Tunnel

# Inertia of an arm's tool, as those of a Panda: kg, kg m and kg m2.
INERTIA = np.array(
    [
        [8.0, 1.0, 0.0, 0.0, 0.3, 0.2],
        [1.0, 12.0, -2.0, -0.4, 0.0, 0.1],
        [0.0, -2.0, 6.0, 0.1, -0.3, 0.0],
        [0.0, -0.4, 0.1, 0.25, 0.02, 0.0],
        [0.3, 0.0, -0.3, 0.02, 0.4, -0.03],
        [0.2, 0.1, 0.0, 0.0, -0.03, 0.12],
    ]
)
STIFFNESS, DAMPING = np.diag([150.0, 400.0, 800.0, 5.0, 10.0, 20.0]), np.diag([60.0, 100.0, 140.0, 2.0, 3.0, 3.0])
PUSH = np.array([7.0, -6.0, 8.0, 0.9, 1.2, -2.0])


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def both(rotation):
    """Matrices that turn twists."""
    whole = np.zeros((*rotation.shape[:-2], 6, 6))
    whole[..., :3, :3] = whole[..., 3:, 3:] = rotation
    return whole


def orientation_and_rate(time):
    """A tool that turns about a vertical axis and nods, about 1.5 rad/s in all; angular velocity in world axes."""
    zero = np.zeros_like(time)
    spin = Rotation.from_rotvec(np.stack([zero, zero, 1.1 * time], axis=-1))
    nod = Rotation.from_rotvec(np.stack([0.5 * np.sin(2.0 * time), zero, zero], axis=-1))
    nodding = spin.apply(np.stack([np.cos(2.0 * time), zero, zero], axis=-1))
    return spin * nod, nodding + np.array([0.0, 0.0, 1.1])


def motion(time):
    """Position, orientation, twist and acceleration of the desired motion."""
    position = np.stack([0.1 * time, 0.2 * np.sin(time), 0.1 * np.cos(2.0 * time)], axis=-1)
    velocity = np.stack([0.1 + 0.0 * time, 0.2 * np.cos(time), -0.2 * np.sin(2.0 * time)], axis=-1)
    acceleration = np.stack([0.0 * time, -0.2 * np.sin(time), -0.4 * np.cos(2.0 * time)], axis=-1)
    orientation, rate = orientation_and_rate(time)
    second = (orientation_and_rate(time + 1e-5)[1] - orientation_and_rate(time - 1e-5)[1]) / 2e-5
    return position, orientation, np.concatenate([velocity, rate], -1), np.concatenate([acceleration, second], -1)


def gains(time):
    """Stiffness and damping that turn with the tool, and an inertia that grows by 40 % and turns otherwise."""
    tool = both(orientation_and_rate(time)[0].as_matrix())
    bend = 0.5 * np.sin(1.5 * time)
    arm = both(Rotation.from_rotvec(np.stack([0.0 * bend, bend, 0.5 * bend], axis=-1)).as_matrix())
    matrices = [tool @ STIFFNESS, tool @ DAMPING, (1.0 + 0.4 * np.sin(time))[..., None, None] * arm @ INERTIA]
    full = [half @ turn.swapaxes(-1, -2) for half, turn in zip(matrices, (tool, tool, arm), strict=True)]
    return [0.5 * (matrix + matrix.swapaxes(-1, -2)) for matrix in full]


def pushes(time, sizes):
    """Wrenches (n, m, 6) of m sizes: squared sines from 0.3 to 1.1 s."""
    share = ((np.asarray(time) - 0.3) / 0.8).clip(0.0, 1.0)
    return np.sin(np.pi * share)[..., None, None] ** 2 * np.outer(sizes, PUSH)


def integrated(sizes, times):
    """Deviations (m, n, 6) under pushes, of ``M v' = f - K e - D (v - v_d) + M a_d`` with ``e = Log(R R_d')``."""

    def rates(time, state):
        position, turned, twist = np.split(state.reshape(len(sizes), 18), [3, 12], axis=1)
        at, tool, speed, acceleration = motion(np.array(time))
        stiffness, damping, mass = gains(np.array(time))
        turned = turned.reshape(-1, 3, 3)
        error = np.c_[position - at, Rotation.from_matrix(turned @ tool.as_matrix().T).as_rotvec()]
        pull = pushes(time, sizes) - error @ stiffness - (twist - speed) @ damping
        spinning = rotations.cross_matrix(twist[:, 3:]) @ turned
        return np.c_[twist[:, :3], spinning.reshape(-1, 9), np.linalg.solve(mass, pull.T).T + acceleration].ravel()

    at, tool, speed, _ = motion(np.array(0.0))
    start = np.tile(np.r_[at, tool.as_matrix().ravel(), speed], len(sizes))
    found = solve_ivp(
        rates, (0.0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-8, atol=1e-10, max_step=0.1
    )
    states = found.y.reshape(len(sizes), 18, -1).swapaxes(1, 2)
    at, tool, _, _ = motion(times)
    turned = [(Rotation.from_matrix(run[:, 3:12].reshape(-1, 3, 3)) * tool.inv()).as_rotvec() for run in states]
    return np.concatenate([states[..., :3] - at, turned], axis=-1)


def simulated(sizes, times, *, transport=True):
    """The same by the plant; without transport, rotations are one more position, whose steps are those of the tool."""
    at, tool, speed, acceleration = motion(times)
    stiffness, damping, mass = gains(times)
    given = {"velocity_desired": speed, "acceleration_desired": acceleration, "stiffness": stiffness}
    given |= {"damping": damping, "force": pushes(times, sizes).swapaxes(0, 1), "dt": times[1] - times[0]}
    plant = AdmittancePlant(mass, feed_forward=True)
    if transport:
        return plant.simulate(at, **given, orientation_desired=tool.as_quat(scalar_first=True))
    turns = (tool[1:] * tool[:-1].inv()).as_rotvec()
    return plant.simulate(np.c_[at, np.r_[np.zeros((1, 3)), turns.cumsum(0)]], **given)


@pytest.fixture(scope="module")
def paths():
    """Deviations by pushes of three sizes, from those without a push: scipy's, with and without transport."""
    times = np.linspace(0.0, 1.6, 1601)
    sizes = [0.0, 0.25, 0.5, 1.0, 5.0]
    runs = [simulated(sizes, times, transport=transport).deviation.numpy() for transport in (True, False)]
    return [run[1:] - run[0] for run in [integrated(sizes, times[::4]), *(run[:, ::4] for run in runs)]]


def largest(values):
    return np.linalg.norm(values, axis=-1).max(axis=-1)


def test_pushes_of_force_and_torque_move_it_as_on_the_rotation_group(paths):
    """Peaks and paths against scipy's integration, 0.2 rad away at most, while the tool turns by 1.8 rad."""
    truth, ours, still = (values[2] for values in paths)
    peak = largest(truth[:, 3:])
    assert 0.15 < peak < 0.25
    assert largest(truth[:, :3]) > 0.01
    assert largest(ours[:, 3:]) == pytest.approx(peak, rel=0.02)
    assert largest(ours[:, :3]) == pytest.approx(largest(truth[:, :3]), rel=0.02)
    assert largest((ours - truth)[:, 3:]) < 0.04 * peak
    assert largest((still - truth)[:, 3:]) > 0.2 * peak  # what the transport is for


def test_what_the_linear_model_leaves_out_is_of_second_order(paths):
    """Halved pushes leave a quarter of the error, to some percent; without transport half of it."""
    truth, ours, still = paths
    errors, without = (largest((values - truth)[..., 3:]) for values in (ours, still))
    np.testing.assert_allclose(errors[1:3] / errors[:2], 4.0, rtol=0.05)
    np.testing.assert_allclose(without[1:3] / without[:2], 2.0, rtol=0.1)
    peaks = largest(truth[..., 3:])
    np.testing.assert_allclose(errors / peaks**2, 1.0 / 6.0, rtol=0.1)
    np.testing.assert_allclose(largest(ours[..., 3:]), peaks, rtol=0.01)
    assert 0.9 < peaks[-1] < 1.0


def test_a_robot_that_turns_far_away_is_told_of():
    given, mass = pose_task(n_ticks=120)
    with pytest.warns(UserWarning, match=r"turned by up to \d\.\d rad from the desired orientation"):
        AdmittancePlant(mass).simulate(**(given | {"force": 40.0 * given["force"]}))


def pose_task(n_ticks=60, dt=5e-3):
    """Arguments of a run along the motion above, under a push all the while."""
    times = dt * np.arange(n_ticks)
    at, tool, speed, acceleration = motion(times)
    stiffness, damping, mass = gains(times)
    given = {"position_desired": at, "velocity_desired": speed, "stiffness": stiffness, "damping": damping}
    given |= {"orientation_desired": tool.as_quat(scalar_first=True), "acceleration_desired": acceleration, "dt": dt}
    return given | {"force": np.sin(9.0 * times)[:, None] * PUSH}, mass


def test_a_tick_is_exact_for_an_inertia_that_varies():
    """Against scipy's exponential of each tick, and ``exp([delta]) (e - delta)`` by scipy's rotations at its end."""
    given, mass = pose_task()
    away = np.array([0.2, -0.1, 0.3])
    start = Rotation.from_rotvec(away) * Rotation.from_quat(given["orientation_desired"][0], scalar_first=True)
    run = AdmittancePlant(mass).simulate(**given, orientation0=start.as_quat(scalar_first=True)).numpy()
    tools = Rotation.from_quat(given["orientation_desired"], scalar_first=True)
    state = np.r_[np.zeros(3), away, given["velocity_desired"][0]]
    for tick in range(59):
        np.testing.assert_allclose(np.r_[run.deviation[tick], run.velocity[tick]], state, rtol=1e-9, atol=1e-11)
        inverse, push = np.linalg.inv(mass[tick]), given["force"][tick] + given["damping"][tick] @ given[
            "velocity_desired"
        ][tick]  # fmt: skip
        rate = np.zeros((13, 13))
        rate[:6, 6:12] = np.eye(6)
        rate[6:12] = np.c_[-inverse @ given["stiffness"][tick], -inverse @ given["damping"][tick], inverse @ push]
        state = (scipy.linalg.expm(given["dt"] * rate) @ np.r_[state, 1.0])[:12]
        turn = tools[tick + 1] * tools[tick].inv()
        state[:3] -= given["position_desired"][tick + 1] - given["position_desired"][tick]
        state[3:6] = turn.apply(state[3:6] - turn.as_rotvec())
    turned = Rotation.from_rotvec(run.deviation[:, 3:]) * tools
    same = np.abs((run.orientation * turned.as_quat(scalar_first=True)).sum(axis=1))
    np.testing.assert_allclose(same, 1.0, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(run.position, run.deviation[:, :3] + given["position_desired"])
    np.testing.assert_array_equal(run.desired_orientation, given["orientation_desired"])


def task_of(orientation):
    """Task of a tool that turns, with one position, which stands still."""
    orientation = torch.tensor(orientation)
    still, gain = torch.zeros(len(orientation), 4).double(), torch.eye(4).double().expand(len(orientation), 4, 4)
    motion = (still[:, :1], still, gain, gain)
    return AdmittancePlant().task(*motion, times=np.zeros(0), dt=0.01, orientation_desired=orientation)


def test_what_turns_with_the_tool_keeps_its_deviation_exactly():
    """At any angle: R and R_d turned by the same delta in the world, from Log(R R_d') = e."""
    away, turn = np.array([1.2, -0.8, 0.5]), np.array([0.3, 0.4, -0.6])
    after = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(away) * Rotation.from_rotvec(-turn)).as_rotvec()
    tools = np.stack([np.array([1.0, 0.0, 0.0, 0.0]), rotations.exp(turn)])
    carried = task_of(tools).carry(0, torch.tensor(np.r_[0.1, away + turn]))
    np.testing.assert_allclose(carried, np.r_[0.1, after], rtol=0, atol=1e-14)


def test_rotations_in_tensors_are_those_of_the_floor(rng):
    first, second = rotations.exp(rng.normal(size=(2, 50, 3)) * rng.choice([1e-12, 1.0, 2.0], size=(2, 50, 1)))
    moved = rng.normal(size=(50, 3))
    tensors = torch.tensor(first), torch.tensor(second)
    np.testing.assert_allclose(rotations.multiply(*tensors), rotations.multiply(first, second))
    np.testing.assert_allclose(rotations.exp(torch.tensor(moved)), rotations.exp(moved), rtol=0, atol=1e-15)
    between = rotations.log(rotations.multiply(second, rotations.conjugate(first)))
    for start in tensors[0], -tensors[0]:
        np.testing.assert_allclose(rotations.between(start, tensors[1]), between, rtol=0, atol=1e-14)
    vectors = torch.tensor(np.r_[np.zeros((1, 3)), moved[:2]], requires_grad=True)
    reference = tensors[0][:1]

    def there_and_back(vector):
        return rotations.between(reference, rotations.multiply(rotations.exp(vector), reference))

    assert torch.autograd.gradcheck(there_and_back, vectors)


def test_it_is_differentiable_in_everything():
    given, mass = pose_task(n_ticks=3, dt=0.02)
    tensors = {name: torch.tensor(value) for name, value in given.items() if name != "dt"}
    for name in ("force", "orientation_desired", "stiffness"):
        tensors[name].requires_grad_()
    inertia = torch.tensor(mass, requires_grad=True)

    def last(force, orientation, inertia):
        quaternion = orientation / orientation.norm(dim=-1, keepdim=True)
        changed = tensors | {"force": force, "orientation_desired": quaternion}
        plant = AdmittancePlant(0.5 * (inertia + inertia.mT), feed_forward=True)
        return plant.simulate(**changed, dt=0.02).orientation[-1]

    assert torch.autograd.gradcheck(last, (tensors["force"], tensors["orientation_desired"], inertia), fast_mode=True)


def test_where_nothing_turns_and_nothing_varies_it_is_the_run_of_positions_to_the_last_bit():
    given, mass = pose_task()
    given |= {"orientation_desired": np.tile(given["orientation_desired"][7], (60, 1)), "force": 10.0 * given["force"]}
    pose = AdmittancePlant(np.tile(mass[0], (60, 1, 1)), feed_forward=True).simulate(**given)
    del given["orientation_desired"]
    given["position_desired"] = np.pad(given["position_desired"], ((0, 0), (0, 3)))
    plain = AdmittancePlant(mass[0], feed_forward=True).simulate(**given)
    assert torch.equal(pose.deviation[:, 3:], plain.position[:, 3:])
    assert torch.equal(pose.position, plain.position[:, :3])
    assert torch.equal(pose.velocity, plain.velocity)
    assert plain.orientation is None


def test_a_mass_may_be_rows_a_function_or_none():
    given, mass = pose_task()
    by_rows = AdmittancePlant(mass).simulate(**given)
    of_time = AdmittancePlant(lambda time: gains(time)[2]).simulate(**given)
    assert torch.equal(by_rows.deviation, of_time.deviation)
    assert torch.equal(
        AdmittancePlant(None).simulate(**given).deviation, AdmittancePlant(1.0).simulate(**given).deviation
    )
    several = AdmittancePlant(torch.tensor(np.stack([mass, 2.0 * mass]))).simulate(**given)
    assert several.deviation.shape == (2, 60, 6)
    torch.testing.assert_close(several.deviation[0], by_rows.deviation, rtol=1e-12, atol=1e-14)
    doubled = AdmittancePlant(2.0 * mass).simulate(**given)
    torch.testing.assert_close(several.deviation[1], doubled.deviation, rtol=1e-12, atol=1e-14)
    shown = [repr(AdmittancePlant(each)) for each in (mass, None, 2)]
    assert shown == [f"AdmittancePlant(mass={each})" for each in ("(60, 6, 6) kg", "None", "2.0 kg")]
    assert "n_outputs=6" in repr(by_rows)
    assert " rad)" in repr(by_rows)


@pytest.mark.parametrize("d", [1, 2])
def test_positions_alone_take_a_mass_that_varies(d):
    """The velocity goes on as it was when the mass changes: two halves of a run, each of one mass."""
    times = 0.01 * np.arange(40)
    still, force = np.zeros((40, d)), np.cos(5.0 * times)[:, None] * np.arange(1.0, d + 1.0)
    gain = np.tile(50.0 * np.eye(d), (40, 1, 1))
    mass = np.repeat([2.0, 5.0], 20)[:, None, None] * (np.eye(d) + 0.2)
    whole = AdmittancePlant(mass).simulate(still, still, gain, 0.2 * gain, force, dt=0.01)
    state = {}
    for half in (slice(0, 20), slice(20, 40)):
        part = [values[half] for values in (still, still, gain, 0.2 * gain, force)]
        run = AdmittancePlant(mass[half.start]).simulate(*part, dt=0.01, **state)
        torch.testing.assert_close(run.position[:19], whole.position[half][:19], rtol=1e-11, atol=1e-15)
        longer = [np.concatenate([values, values[-1:]]) for values in part]
        end = AdmittancePlant(mass[half.start]).simulate(*longer, dt=0.01, **state)
        state = {"position0": end.position[-1], "velocity0": end.velocity[-1]}


def test_parts_that_do_nothing_leave_a_pose_where_it_was():
    """Tick by tick instead of a block at a time."""
    given, mass = pose_task()
    given["position0"] = given["position_desired"][0] + 0.01
    plain = AdmittancePlant(mass, feed_forward=True).simulate(**given)
    looped = AdmittancePlant(mass, feed_forward=True, sensor=ForceSensor(range=(np.inf,) * 6)).simulate(**given)
    for name in ("deviation", "velocity", "orientation", "commanded_orientation"):
        torch.testing.assert_close(getattr(looped, name), getattr(plain, name), rtol=1e-11, atol=1e-13)
    batch = given | {"orientation_desired": np.stack([given["orientation_desired"]] * 2)}
    several = AdmittancePlant(mass, feed_forward=True).simulate(**batch)
    torch.testing.assert_close(several.orientation[1], plain.orientation, rtol=1e-11, atol=1e-13)


def test_a_position_loop_follows_poses_as_they_are_commanded():
    """One that is fast takes every command a tick later, in the world: to half of ``delta x e`` of a tick, 1e-3 rad."""
    given, mass = pose_task()
    plant = AdmittancePlant(mass, feed_forward=True, position_loop=PositionLoop(1e4, delay_steps=0))
    run = plant.simulate(**given).numpy()
    np.testing.assert_allclose(run.position[1:], run.commanded_position[:-1], rtol=0, atol=1e-9)
    behind = rotations.log(rotations.multiply(run.orientation[1:], rotations.conjugate(run.commanded_orientation[:-1])))
    apart = np.linalg.norm(run.deviation[:-1, 3:], axis=1) * 1.6 * given["dt"]
    assert (np.linalg.norm(behind, axis=1) <= 0.5 * apart + 1e-9).all()
    slow = AdmittancePlant(mass, feed_forward=True, position_loop=PositionLoop(20.0, delay_steps=2)).simulate(**given)
    lag = (slow.orientation[-1] - slow.commanded_orientation[-1]).norm() * 2.0 / slow.velocity[-1, 3:].norm()
    assert float(lag) == pytest.approx(2.0 / (2.0 * np.pi * 20.0) + 2.5 * given["dt"], rel=0.15)


def test_walls_press_on_the_position_alone():
    """Of a pose with one in the plane, where gains and masses do not couple the two."""
    times = 5e-3 * np.arange(120)
    still = np.tile([0.1, 0.3], (120, 1))
    gain = np.tile(np.diag([200.0, 300.0, 5.0, 6.0, 7.0]), (120, 1, 1))
    force = np.tile([6.0, -2.0, 0.1, 0.2, -0.1], (120, 1))
    tool = orientation_and_rate(times)[0].as_quat(scalar_first=True)
    plant = AdmittancePlant(2.0, environment=Tunnel(2e3), substeps=2)
    pose = plant.simulate(
        still, np.zeros((120, 5)), gain, 0.1 * gain, force, dt=5e-3, orientation_desired=tool, position0=[0.0, 0.3]
    )
    alone = [values[..., :2] for values in (still, np.zeros((120, 2)), gain[:, :2], 0.1 * gain[:, :2], force)]
    plain = plant.simulate(*alone, dt=5e-3, position0=[0.0, 0.3])
    torch.testing.assert_close(pose.position, plain.position, rtol=1e-11, atol=1e-14)
    torch.testing.assert_close(pose.force[:, 2:], torch.tensor(force[:, 2:]), rtol=0, atol=0)
    assert (plain.force[:, 0] != 6.0).any()


def test_a_sensor_has_limits_for_each_block():
    given, _ = pose_task()
    sensor = ForceSensor(range=(3.0,) * 3 + (0.2,) * 3, resolution=(0.5,) * 3 + (0.0,) * 3, bias=(0.0,) * 5 + (0.1,))
    read = sensor.start(torch.zeros(6).double(), 1e-3)
    force, saturated = read(tensor(1.3, -9.0, 0.2, 0.15, -4.0, 0.01))
    np.testing.assert_allclose(force, [1.5, -3.0, 0.0, 0.15, -0.2, 0.11])
    assert bool(saturated)
    run = AdmittancePlant(5.0, sensor=sensor).simulate(**given)
    assert run.saturated.any()
    with pytest.raises(ValueError, match="range has 2 values, but the force has 6 axes"):
        ForceSensor(range=(1.0, 2.0)).start(torch.zeros(6), 1e-3)
    with pytest.raises(ValueError, match=r"resolution is 0\.3 N, must be .* at most 0\.2"):
        ForceSensor(range=(1.0, 0.2), resolution=0.3)


def swinging(given):
    """The same, with a stiffness that swings as far as four times itself while it turns with the tool."""
    times = given["dt"] * np.arange(len(given["stiffness"]))
    return given | {"stiffness": given["stiffness"] * (1.0 + 3.0 * np.sin(15.0 * times) ** 2)[:, None, None]}


def test_the_tank_holds_while_the_tool_turns_and_the_inertia_varies():
    """``H + T - W`` never grows, where W is the work of forces, of the desired motion, and of ``1/2 v' dM v``."""
    given, mass = pose_task(n_ticks=200)
    run = AdmittancePlant(mass, stiffness_filter=EnergyTank(efficiency=0.01)).simulate(**swinging(given)).numpy()
    turns = task_of(given["orientation_desired"])
    step = np.c_[np.diff(given["position_desired"], axis=0), turns.steps[:-1, 1:].numpy()]
    back = np.einsum("tji,tj->ti", turns.transport[:-1].numpy(), run.deviation[1:, 3:])
    moved = np.c_[run.deviation[1:, :3], back]  # as before the desired orientation turned, but for its step
    held = run.force + np.einsum("tij,tj->ti", run.damping, given["velocity_desired"])
    spring = [0.5 * np.einsum("ti,tij,tj->t", e, run.stiffness[:-1], e) for e in (moved + step, moved)]
    work = (held[:-1] * (moved + step - run.deviation[:-1])).sum(axis=1) + spring[1] - spring[0]
    work += 0.5 * np.einsum("ti,tij,tj->t", run.velocity[1:], np.diff(mass, axis=0), run.velocity[1:])
    stored = 0.5 * np.einsum("ti,tij,tj->t", run.deviation, run.stiffness, run.deviation)
    stored += 0.5 * np.einsum("ti,tij,tj->t", run.velocity, mass, run.velocity) + run.tank_energy
    excess = stored[1:] - work.cumsum() - stored[0]
    assert excess.max() <= 1e-12 * np.abs(work).sum()
    assert 5 < len(run.interventions) < 195
    # What each tick dissipates, less what the next stiffness costs, as the tool sees the two
    ends = moved + step
    kinetic = [0.5 * np.einsum("ti,tij,tj->t", v, mass[:-1], v) for v in (run.velocity[:-1], run.velocity[1:])]
    start = 0.5 * np.einsum("ti,tij,tj->t", run.deviation[:-1], run.stiffness[:-1], run.deviation[:-1])
    lost = start + kinetic[0] + (held[:-1] * (ends - run.deviation[:-1])).sum(axis=1) - spring[0] - kinetic[1]
    tool = np.tile(np.eye(6), (199, 1, 1))
    tool[:, 3:, 3:] = turns.transport[:-1]
    change = run.stiffness[1:] - tool @ run.stiffness[:-1] @ tool.swapaxes(1, 2)
    cost = 0.5 * np.einsum("ti,tij,tj->t", run.deviation[1:], change, run.deviation[1:])
    expected = np.maximum(run.tank_energy[:-1] + 0.01 * lost - cost, 0.0)
    np.testing.assert_allclose(run.tank_energy[1:], expected, rtol=1e-9, atol=1e-12 * stored.max())
    assert run.tank_energy.max() > 1e-3 * stored.max()


@pytest.mark.parametrize("stiffness_filter", [EnergyTank(), RateLimit()], ids=["tank", "rate limit"])
def test_a_stiffness_that_turns_with_the_tool_is_let_through(stiffness_filter):
    given, mass = pose_task()
    start = rotations.multiply(rotations.exp(np.array([0.2, 0.1, -0.3])), given["orientation_desired"][0])
    run = AdmittancePlant(mass[0], stiffness_filter=stiffness_filter).simulate(**given, orientation0=start).numpy()
    assert len(run.interventions) == 0
    np.testing.assert_allclose(run.stiffness, given["stiffness"], rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("is_pose", [True, False])
def test_the_rate_limits_function_never_grows_between_two_motions(is_pose):
    """Whatever state and held force, ``E' P+ E <= P + W`` of each tick's own mass, and no less was let through.

    The inertia grows by a third meanwhile. The integral of the deviation comes from a fourth block of the exponential.
    """
    given, mass = pose_task(n_ticks=200)
    given = swinging(given)
    tool = np.tile(np.eye(6), (200, 1, 1))
    if is_pose:
        tool[:, 3:, 3:] = task_of(given["orientation_desired"]).transport
    else:
        given["position_desired"] = np.pad(given["position_desired"], ((0, 0), (0, 3)))
        del given["orientation_desired"]
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    alpha = 0.5 * np.linalg.eigvalsh(inverse @ given["damping"] @ inverse.swapaxes(1, 2)).min()
    run = AdmittancePlant(mass, stiffness_filter=RateLimit(alpha)).simulate(**given)
    function = lyapunov_matrix(run.stiffness, run.damping, torch.tensor(mass), alpha).numpy()
    rate = np.zeros((199, 24, 24))
    rate[:, :18, :18] = admittance_rate(run.stiffness, run.damping, torch.tensor(mass))[:-1].numpy()
    rate[:, 18:, :6] = np.eye(6)
    tick = scipy.linalg.expm(given["dt"] * rate)[..., :18]
    fed = tick[:, :6] - np.eye(18)[:6] + alpha * tick[:, 18:]
    end = np.concatenate([tool[:-1] @ tick[:, :6], tick[:, 6:12]], axis=1)
    growth = end.swapaxes(1, 2) @ function[1:] @ end
    growth[:, :12, :12] -= function[:-1]
    growth[:, 12:] -= fed
    growth[:, :, 12:] -= fed.swapaxes(1, 2)
    scale = 1.0 / np.sqrt(np.concatenate([np.diagonal(function[0]), given["dt"] ** 2 / np.diagonal(mass[0])]))
    worst = np.linalg.eigvalsh(scale[:, None] * growth * scale)[:, -1]
    held = run.filter_share[1:].numpy() < 1.0
    assert 5 < held.sum() < 195
    assert worst.max() <= 1e-11
    assert worst[held].min() >= -1e-9


@pytest.mark.parametrize(
    ("parts", "changes", "words"),
    [
        (
            {"stiffness_filter": RateLimit(), "mass": np.linspace(1.0, 30.0, 60)[:, None, None] * INERTIA},
            {},
            "the mass rises, or the desired orientation turns, faster than the damping can pay for",
        ),
        (
            {"mass": np.tile(np.eye(6), (59, 1, 1))},
            {},
            "mass has shape (59, 6, 6), but stiffness has shape (60, 6, 6): give a number",
        ),
        ({"mass": lambda time: np.tile(np.eye(3), (len(time), 1, 1))}, {}, "mass has shape (60, 3, 3)"),
        ({"mass": lambda time: -1.0}, {}, "mass is -1.0 kg"),
        (
            {},
            {"velocity_desired": np.zeros((60, 3))},
            "velocity_desired has shape (60, 3), must have shape (..., T, d)",
        ),
        ({}, {"orientation_desired": np.ones((60, 4))}, "the squared norm of orientation_desired[0] is 4.0, must be 1"),
        ({}, {"orientation_desired": np.ones((60, 3))}, "orientation_desired has shape (60, 3)"),
        ({}, {"orientation0": [1.0, 0.0, 0.0]}, "orientation0 has shape (3,)"),
        ({}, {"position0": np.zeros(6)}, "position0 has shape (6,), must have shape (..., p)"),
        ({}, {"orientation_desired": None, "orientation0": np.ones(4)}, "orientation0 is given, must come with"),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(parts, changes, words):
    given, mass = pose_task()
    with pytest.raises(ValueError, match=re.escape(words)):
        AdmittancePlant(**{"mass": mass, **parts}).simulate(**(given | changes))
