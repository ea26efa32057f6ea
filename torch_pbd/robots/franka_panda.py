"""The Franka Emika Panda as a model for MuJoCo, written from published figures; no meshes, capsules instead.

Kinematics: modified Denavit-Hartenberg parameters, limits, and the hand's mass are those of the manufacturer's
interface specification. Inertia: C. Gaz, M. Cognetti, A. Oliva, P. Robuffo Giordano and A. De Luca, "Dynamic
identification of the Franka Emika Panda robot with retrieval of feasible parameters using penalty-based optimization",
IEEE Robotics and Automation Letters 4(4), 2019, table of feasible parameters. What they cannot identify, such as the
height of the first centre of mass, has no effect on the motion of an arm with a fixed base. Of the motors, which are
behind the torque sensors that they identified with, no figures are published; 0.1 kg m^2 at the joint is what MuJoCo
Menagerie's Panda takes.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch_pbd import checks
from torch_pbd.extras import optional

HOME = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
"""Joint angles in rad, far from limits and singularities: the hand points down, 0.31 m before the base."""

Capsule = tuple[tuple[float, float, float], tuple[float, float, float], float]
_QUARTER = math.pi / 2


class Link(NamedTuple):
    """A moving link with its joint, in the frame of the link: z is the joint's axis.

    The frame lies at ``Rot_x(alpha) Trans_x(a) Trans_z(d)`` in that of the link before, m and rad (J. J. Craig).
    """

    a: float
    alpha: float
    d: float
    low: float  # rad
    high: float  # rad
    torque: float  # Nm
    mass: float  # kg
    center: tuple[float, float, float]  # of mass, m
    inertia: tuple[float, float, float, float, float, float]  # about it, xx yy zz xy xz yz, kg m^2
    shape: tuple[Capsule, ...]  # ends and radius, m: to be looked at only


LINKS = (
    Link(
        0.0, 0.0, 0.333, -2.8973, 2.8973, 87.0, 4.970684, (3.875e-3, 2.081e-3, 0.0),
        (7.0337e-1, 7.0661e-1, 9.117e-3, -1.39e-4, 6.772e-3, 1.9169e-2),
        (((0.0, 0.0, -0.19), (0.0, 0.0, -0.03), 0.062), ((0.0, -0.065, 0.0), (0.0, 0.065, 0.0), 0.06)),
    ),
    Link(
        0.0, -_QUARTER, 0.0, -1.7628, 1.7628, 87.0, 0.646926, (-3.141e-3, -2.872e-2, 3.495e-3),
        (7.962e-3, 2.811e-2, 2.5995e-2, -3.925e-3, 1.0254e-2, 7.04e-4),
        (((0.0, -0.02, 0.0), (0.0, -0.19, 0.0), 0.06),),
    ),
    Link(
        0.0, _QUARTER, 0.316, -2.8973, 2.8973, 87.0, 3.228604, (2.7518e-2, 3.9252e-2, -6.6502e-2),
        (3.7242e-2, 3.6155e-2, 1.083e-2, -4.761e-3, -1.1396e-2, -1.2805e-2),
        (((0.0, 0.0, -0.13), (0.03, 0.0, -0.03), 0.058), ((0.0825, -0.055, 0.0), (0.0825, 0.055, 0.0), 0.055)),
    ),
    Link(
        0.0825, _QUARTER, 0.0, -3.0718, -0.0698, 87.0, 3.587895, (-5.317e-2, 1.04419e-1, 2.7454e-2),
        (2.5853e-2, 1.9552e-2, 2.8323e-2, 7.796e-3, -1.332e-3, 8.641e-3),
        (((-0.01, 0.02, 0.0), (-0.0825, 0.10, 0.0), 0.056), ((-0.0825, 0.10, 0.0), (-0.0825, 0.13, 0.0), 0.056)),
    ),
    Link(
        -0.0825, -_QUARTER, 0.384, -2.8973, 2.8973, 12.0, 1.225946, (-1.1953e-2, 4.1065e-2, -3.8437e-2),
        (3.5549e-2, 2.9474e-2, 8.627e-3, -2.117e-3, -4.037e-3, 2.29e-4),
        (((0.0, 0.0, -0.25), (0.0, 0.03, -0.14), 0.054), ((0.0, 0.05, -0.13), (0.0, 0.03, 0.0), 0.042)),
    ),
    Link(
        0.0, _QUARTER, 0.0, -0.0175, 3.7525, 12.0, 1.666555, (6.0149e-2, -1.4117e-2, -1.0517e-2),
        (1.964e-3, 4.354e-3, 5.433e-3, 1.09e-4, -1.158e-3, 3.41e-4),
        (((0.0, 0.0, -0.03), (0.0, 0.0, 0.03), 0.05), ((0.01, 0.0, 0.0), (0.08, 0.0, 0.0), 0.048)),
    ),
    Link(
        0.088, _QUARTER, 0.0, -2.8973, 2.8973, 12.0, 0.735522, (1.0517e-2, -4.252e-3, 6.1597e-2),
        (1.2516e-2, 1.0027e-2, 4.815e-3, -4.28e-4, -1.196e-3, -7.41e-4),
        (((0.0, 0.0, 0.03), (0.0, 0.0, 0.07), 0.043),),
    ),
)  # fmt: skip

FLANGE = 0.107
"""Distance of the flange from the last link's frame, along z, in m."""

# The hand, turned by -45 degrees at the flange: its mass and inertia as the manufacturer configures it, and its tip.
_HAND = """
<body name="hand" pos="0 0 {flange}" quat="{half} 0 0 -{other}">
  <inertial pos="-0.01 0 0.03" mass="0.73" diaginertia="0.001 0.0025 0.0017"/>
  <geom class="dark" type="box" pos="0 0 0.033" size="0.025 0.1 0.033"/>
  <geom type="box" pos="0 0.03 0.085" size="0.01 0.008 0.0184"/>
  <geom type="box" pos="0 -0.03 0.085" size="0.01 0.008 0.0184"/>
  <site name="tool" pos="0 0 0.1034" size="0.005"/>
</body>"""

_MODEL = """<mujoco model="panda">
<option timestep="{timestep}" gravity="0 0 -9.81"/>
<compiler angle="radian" autolimits="true"/>
<visual><global offwidth="1280" offheight="960"/><headlight ambient=".4 .4 .4" diffuse=".5 .5 .5"/></visual>
<default>
  <joint armature="{armature}"/>
  <geom contype="0" conaffinity="0" mass="0" rgba="0.93 0.94 0.95 1"/>
  <default class="dark"><geom rgba="0.25 0.27 0.3 1"/></default>
</default>
<worldbody>
<body name="link0">
  <geom class="dark" type="cylinder" fromto="0 0 0 0 0 0.03" size="0.1"/>
  <geom type="capsule" fromto="-0.06 0 0.06 0 0 0.07" size="0.06"/>
  <geom type="cylinder" fromto="0 0 0.03 0 0 0.14" size="0.062"/>
{links}
</body>
</worldbody>
<actuator>
{motors}
</actuator>
</mujoco>"""


def panda_mjcf(*, hand: bool = True, armature: float = 0.1, timestep: float = 1e-3) -> str:
    """Text of an MJCF file of the arm: joints ``joint1`` to ``joint7`` with torque motors, and a site ``tool``.

    Joints have no friction, and bodies do not collide.

    Parameters
    ----------
    hand : bool, default=True
        With the manufacturer's hand of 0.73 kg, closed; the tool is then its tip, 0.1034 m beyond the flange, else
        the flange.
    armature : float, default=0.1
        Inertia of each motor at its joint, kg m^2; libfranka's model has none.
    timestep : float, default=1e-3
        Of the simulation, s.

    Returns
    -------
    str

    References
    ----------
    C. Gaz et al., IEEE Robotics and Automation Letters 4(4), 2019, for the inertia; Franka Control Interface,
    "Robot and interface specifications", for all other figures.
    """
    checks.number(armature, "armature", least=0.0, unit="kg m^2")
    checks.number(timestep, "timestep", above=0.0, most=0.01, unit="s")
    half = math.pi / 8
    inner = f'<site name="tool" pos="0 0 {FLANGE}" size="0.005"/>'
    if checks.flag(hand, "hand"):
        inner = _HAND.format(flange=FLANGE, half=math.cos(half), other=math.sin(half))
    for number, link in reversed(list(enumerate(LINKS, start=1))):
        inner = _body(number, link, inner)
    motors = [
        f'<motor name="motor{i}" joint="joint{i}" ctrlrange="{-link.torque} {link.torque}"/>'
        for i, link in enumerate(LINKS, start=1)
    ]
    return _MODEL.format(timestep=timestep, armature=armature, links=inner, motors="\n".join(motors))


def panda(*, hand: bool = True, armature: float = 0.1, timestep: float = 1e-3) -> Any:
    """Franka Emika Panda as a ``mujoco.MjModel``, with the parameters of ``panda_mjcf``; needs the extra ``robot``.

    Examples
    --------
    >>> from torch_pbd.robots import HOME, operational_inertia, panda
    >>> operational_inertia(panda(), HOME, "tool").diagonal()[:3].round(1)  # kg; a schedule without mass assumes 1
    array([12.5,  5.1,  6.5])
    """
    text = panda_mjcf(hand=hand, armature=armature, timestep=timestep)
    return optional("mujoco", "robot", "a model for MuJoCo").MjModel.from_xml_string(text)


def _body(number: int, link: Link, inner: str) -> str:
    """A link, with those that it carries inside."""
    # Rot_x(alpha) (a, 0, d): turns and shifts along one axis commute.
    place = (link.a, -math.sin(link.alpha) * link.d, math.cos(link.alpha) * link.d)
    turn = (math.cos(link.alpha / 2), math.sin(link.alpha / 2), 0.0, 0.0)
    shapes = [f'<geom type="capsule" fromto="{_text(start + end)}" size="{size}"/>' for start, end, size in link.shape]
    return "\n".join(
        [
            f'<body name="link{number}" pos="{_text(place)}" quat="{_text(turn)}">',
            f'<inertial pos="{_text(link.center)}" mass="{link.mass}" fullinertia="{_text(link.inertia)}"/>',
            f'<joint name="joint{number}" axis="0 0 1" range="{link.low} {link.high}"/>',
            *shapes,
            inner,
            "</body>",
        ]
    )


def _text(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, numbers))
