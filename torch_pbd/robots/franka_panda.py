"""The Franka Emika Panda as a model for MuJoCo: ``panda.xml``, which says where its figures are from."""

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from torch_pbd import checks
from torch_pbd.extras import optional

HOME = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
"""Joint angles in rad, far from limits and singularities: the hand points down, 0.31 m before the base."""


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
    model: Any = ElementTree.parse(Path(__file__).with_name("panda.xml")).getroot()
    model.find("option").set("timestep", repr(timestep))
    model.find("default/joint").set("armature", repr(armature))
    if not checks.flag(hand, "hand"):
        last = model.find(".//body[@name='link7']")
        flange = last.find("body").get("pos")
        last.remove(last.find("body"))
        ElementTree.SubElement(last, "site", name="tool", pos=flange, size="0.005")
    return ElementTree.tostring(model, encoding="unicode")


def panda(*, hand: bool = True, armature: float = 0.1, timestep: float = 1e-3) -> Any:
    """Franka Emika Panda as a ``mujoco.MjModel``, with the parameters of `panda_mjcf`; needs the extra ``robot``.

    Examples
    --------
    >>> from torch_pbd.robots import HOME, operational_inertia, panda
    >>> operational_inertia(panda(), HOME, "tool").diagonal()[:3].round(1)  # kg; a schedule without mass assumes 1
    array([12.5,  5.1,  6.5])
    """
    text = panda_mjcf(hand=hand, armature=armature, timestep=timestep)
    return optional("mujoco", "robot", "a model for MuJoCo").MjModel.from_xml_string(text)
