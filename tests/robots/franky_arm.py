"""A Franka arm behind libfranka's protocol: franky-sim in a process of its own, pushed and watched from here."""

import multiprocessing
from contextlib import contextmanager
from xml.etree import ElementTree

import numpy as np

from torch_pbd.robots.franka_panda import HOME

TIP = 0.1034  # of the hand, m


def build():
    """Simulator with the arm at HOME, not started, and the arm; its tool is a site."""
    from franky_sim.mujoco_simulator import MujocoSimulator

    simulator = MujocoSimulator()
    simulator.init()
    robot = simulator.add_robot(initial_q=HOME)
    hand = next(body for body in simulator.scene.iter("body") if body.get("name") == "robot0_hand")
    ElementTree.SubElement(hand, "site", name="tool", pos=f"0 0 {TIP}")
    return simulator, robot


def reduce(model, friction, rotors):
    """Leave out the friction of joints, or the inertia of the motors, which libfranka's model does not know."""
    if not friction:
        model.dof_frictionloss[:], model.dof_damping[:] = 0.0, 0.0
    if not rotors:
        model.dof_armature[:7] = 0.0
    return model


def model_of(friction=True, rotors=True):
    """The arm alone as a MuJoCo model, with a site ``tool``."""
    simulator, robot = build()
    simulator.start()
    return reduce(robot.model, friction, rotors)


def _serve(pipe, pace, options):
    import mujoco
    from franky_sim import SimulationServer

    simulator, robot = build()
    order, seen = (0.0, 0.0, 1.0, np.zeros(6)), []

    def push(_):
        data, hand = robot.data, robot.model.body("robot0_hand").id
        origin, onset, duration, wrench = order
        share = np.clip((clock() - origin - onset) / duration, 0.0, 1.0)
        force, torque = np.split(np.sin(np.pi * share) ** 2 * wrench, 2)
        tip = data.site("tool").xpos
        data.xfrc_applied[hand] = np.concatenate([force, torque + np.cross(tip - data.xipos[hand], force)])

    with SimulationServer(simulator) as server:
        reduce(robot.model, **options)
        clock = lambda: 1e-3 * server.robot_servers[0]._FrankaServer__message_id  # noqa: E731
        simulator.register_pre_step_callback(push)
        pipe.send(robot.hostname)
        turn = np.empty(4)
        while True:
            if pipe.poll():
                message = pipe.recv()
                if message is None:
                    break
                order = message
                seen.clear()
            site = robot.data.site("tool")
            mujoco.mju_mat2Quat(turn, site.xmat)
            seen.append([clock(), *site.xpos, *turn])
            server.run_once(pace)
    pipe.send(np.array(seen))


class Watched:
    """A franky.Robot that tells the simulation when its schedule begins: at the first state that is asked for."""

    def __init__(self, robot, pipe, settle, onset, duration, wrench):
        self._robot, self._pipe, self._order = robot, pipe, (onset, duration, np.asarray(wrench, dtype=float))
        self._settle, self.origin = settle, None

    def __getattr__(self, name):
        return getattr(self._robot, name)

    @property
    def state(self):
        state = self._robot.state
        if self.origin is None:
            self.origin = state.time.to_sec() + self._settle
            self._pipe.send((self.origin, *self._order))
        return state


@contextmanager
def served(pace=1.0, friction=True, rotors=True):
    """Address of an arm, and the pipe to it, which answers None with all it has seen since the last order."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, pace, {"friction": friction, "rotors": rotors}), daemon=True)
    process.start()
    try:
        yield ours.recv(), ours
    finally:
        process.join(5.0)
        process.kill()
