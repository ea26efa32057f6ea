"""A learned pose task on a Franka arm by franky, against franky-sim, which speaks libfranka's protocol over MuJoCo.

``python scripts/benchmarks/franky_pushes.py`` prints the table of `docs/arms.md`, and writes its picture.
"""

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import franky
import mujoco
import numpy as np
from arm_pushes import peg
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MujocoSimulator

from torch_pbd import rotations
from torch_pbd.control import Schedule, simulate
from torch_pbd.robots import HOME, inverse_kinematics, operational_inertia, panda
from torch_pbd.robots.franky import run

TIP = 0.1034  # of the hand, m
SETTLE, ONSET, DURATION = 0.5, 1.2, 0.8  # s
PUSHES = {"12 N": [12.0, 0.0, 0.0, 0.0, 0.0, 0.0], "1.2 Nm": [0.0, 0.0, 0.0, 0.0, 0.0, 1.2]}
PICTURE = Path(__file__).parents[2] / "docs" / "pictures" / "franky.png"


class Case(NamedTuple):
    """What the simulated arm has that libfranka's model, by which franky controls it, has not."""

    name: str
    friction: bool  # of the joints: 0.25 to 1.1 Nm, and 0.21 Nm s/rad
    motors: bool  # inertia at the joints: 0.07 to 0.2 kg m^2
    is_told: bool = False  # franky of the friction


CASES = (
    Case("without friction and motors' inertia", friction=False, motors=False),
    Case("without friction", friction=False, motors=True),
    Case("as it is", friction=True, motors=True),
    Case("as it is, franky told of the friction", friction=True, motors=True, is_told=True),
)


class Measured(NamedTuple):
    """Deviations (T, 6) of a case: undisturbed, under each push, and what each push does to the plant."""

    time: Any
    calm: Any
    pushed: dict[str, Any]
    plant: dict[str, Any]


def build(case: Case, start: Any) -> tuple[Any, Any]:
    """Simulator, not started, and its arm, whose tool is a site; :func:`reduce` follows the start."""
    simulator = MujocoSimulator()
    simulator.init()
    robot = simulator.add_robot(initial_q=tuple(start))
    hand = next(body for body in simulator.scene.iter("body") if body.get("name") == "robot0_hand")
    ElementTree.SubElement(hand, "site", name="tool", pos=f"0 0 {TIP}")
    return simulator, robot


def reduce(model: Any, case: Case) -> Any:
    """Leave out what the case leaves out."""
    if not case.friction:
        model.dof_frictionloss[:], model.dof_damping[:] = 0.0, 0.0
    if not case.motors:
        model.dof_armature[:7] = 0.0
    return model


def prepared(case: Case) -> tuple[Schedule, Any, Any]:
    """The task, learned, with the inertia of the simulated arm; its joint angles; franky's friction, or None."""
    planned = peg(300.0, 15.0, 100.0)  # pushes stay within the 0.25 rad at which franky clips
    joints = inverse_kinematics(panda(), planned.position, planned.orientation, "tool", start=HOME)
    simulator, robot = build(case, joints[0])
    simulator.start()
    model = reduce(robot.model, case)
    friction = None
    if case.is_told:
        coulomb, viscous = model.dof_frictionloss[:7].tolist(), model.dof_damping[:7].tolist()
        friction = franky.FrictionCompensationParams(coulomb, viscous, max_torque=[3.0] * 7)
    return planned.with_inertia(operational_inertia(model, joints, "tool")), joints, friction


def serve(pipe: Any, case: Case, start: Any) -> None:
    """Run the simulation until None comes; tuples that come are pushes, and the answer is where the tool was."""
    simulator, robot = build(case, start)
    order: Any = (0.0, np.zeros(6))
    seen: list[Any] = []

    def clock() -> float:
        """The robot's time, s: messages are sent every millisecond."""
        return 1e-3 * server.robot_servers[0]._FrankaServer__message_id

    def push(_: Any) -> None:
        data, hand = robot.data, robot.model.body("robot0_hand").id
        share = np.clip((clock() - order[0] - ONSET) / DURATION, 0.0, 1.0)
        force, torque = np.split(np.sin(np.pi * share) ** 2 * order[1], 2)
        lever = data.site("tool").xpos - data.xipos[hand]
        data.xfrc_applied[hand] = np.concatenate([force, torque + np.cross(lever, force)])

    with SimulationServer(simulator) as server:
        reduce(robot.model, case)
        simulator.register_pre_step_callback(push)
        pipe.send(robot.hostname)
        turn = np.empty(4)
        while True:
            if pipe.poll():
                order = pipe.recv()
                if order is None:
                    break
                seen.clear()
            site = robot.data.site("tool")
            mujoco.mju_mat2Quat(turn, site.xmat)
            seen.append([clock(), *site.xpos, *turn])
            server.run_once()
    pipe.send(np.array(seen))


class Watched:
    """A franky.Robot that tells the simulation when its schedule begins: at the first state that is asked for."""

    def __init__(self, robot: Any, pipe: Any, wrench: Any) -> None:
        self._robot, self._pipe, self._wrench = robot, pipe, np.asarray(wrench, dtype=float)
        self.origin: float | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    @property
    def state(self) -> Any:
        state = self._robot.state
        if self.origin is None:
            self.origin = state.time.to_sec() + SETTLE
            self._pipe.send((self.origin, self._wrench))
        return state


@contextmanager
def served(case: Case, start: Any) -> Iterator[tuple[str, Any]]:
    """Address of a simulated arm in a process of its own, and the pipe to it."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, case, start), daemon=True)
    process.start()
    try:
        yield ours.recv(), ours
    finally:
        process.join(5.0)
        process.kill()


def followed(case: Case, schedule: Schedule, start: Any, friction: Any, wrench: Any) -> Any:
    """Deviation (T, 6) of the arm from the schedule at its rows, in the simulation's own time."""
    with served(case, start) as (address, pipe):
        robot = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
        robot.set_collision_behavior(100.0, 100.0)
        watched = Watched(robot, pipe, wrench)
        options = {} if friction is None else {"friction": friction}
        try:  # a machine that is busy with other things may be late
            run(watched, schedule, settle=SETTLE, max_step=1.0, posture_task=franky.PostureTask(start, 10.0), **options)
        finally:
            pipe.send(None)
            seen = pipe.recv()
    rows = np.searchsorted(seen[:, 0], watched.origin + schedule.time - 5e-4).clip(max=len(seen) - 1)
    turn = rotations.log(rotations.multiply(seen[rows, 4:], rotations.conjugate(schedule.orientation)))
    return np.hstack([seen[rows, 1:4] - schedule.position, turn])


def measured(case: Case) -> Measured:
    """A case, undisturbed and under both pushes."""
    schedule, joints, friction = prepared(case)
    share = np.sin(np.pi * np.clip((schedule.time - ONSET) / DURATION, 0.0, 1.0)) ** 2
    calm = followed(case, schedule, joints[0], friction, np.zeros(6))
    pushed = {name: followed(case, schedule, joints[0], friction, wrench) for name, wrench in PUSHES.items()}
    forces = {name: np.outer(share, wrench) for name, wrench in PUSHES.items()}
    still, *plants = (simulate(schedule, force).deviation for force in (np.zeros_like(calm), *forces.values()))
    plant = {name: found - still for name, found in zip(forces, plants, strict=True)}
    return Measured(schedule.time, calm, pushed, plant)


def peaks(deviation: Any) -> Any:
    """Largest lengths of translation and rotation, mm and mrad."""
    return 1e3 * np.array([np.linalg.norm(part, axis=1).max() for part in np.split(deviation, 2, axis=1)])


def draw(found: dict[str, Measured]) -> None:
    """Picture of the arm as it is and without friction, beside the plant."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    for ax, (push, block, scale, unit) in zip(
        axes, (("12 N", slice(3), 1e3, "mm"), ("1.2 Nm", slice(3, 6), 180.0 / np.pi, "degrees")), strict=True
    ):
        bare, whole = found[CASES[1].name], found[CASES[2].name]  # of one inertia
        for motion, style, label in (
            (whole.calm, "r--", "as it is, undisturbed"),
            (whole.pushed[push] - whole.calm, "r-", "as it is, what the push does"),
            (bare.pushed[push] - bare.calm, "b-", "without friction, what the push does"),
            (bare.plant[push], "k:", "the plant"),
        ):
            ax.plot(bare.time, scale * np.linalg.norm(motion[:, block], axis=1), style, label=label)
        ax.set(xlabel="time [s]", ylabel=f"deviation [{unit}]", title=f"push of {push}")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    """Print the table, and write the picture."""
    print("| franky-sim | undisturbed | push of 12 N (plant) | push of 1.2 Nm (plant) |")
    print("| --- | --- | --- | --- |")
    found = {case.name: measured(case) for case in CASES}
    for name, each in found.items():
        far, wide = peaks(each.calm)
        effects = [peaks(each.pushed[push] - each.calm)[i] for i, push in enumerate(PUSHES)]
        plants = [peaks(each.plant[push])[i] for i, push in enumerate(PUSHES)]
        print(
            f"| {name} | {far:.2f} mm, {wide:.1f} mrad | {effects[0]:.2f} mm ({plants[0]:.2f}) | "
            f"{effects[1]:.1f} mrad ({plants[1]:.1f}) |"
        )
    draw(found)


if __name__ == "__main__":
    main()
