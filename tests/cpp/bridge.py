"""The controller in C++ as an object of Python, and both of them at once."""

import ctypes
import functools
import math
import shutil
import subprocess
import tempfile
from ctypes import POINTER, c_bool, c_char_p, c_double, c_long, c_uint, c_void_p, create_string_buffer
from pathlib import Path

import numpy as np
import pytest

from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus

ROOT = Path(__file__).parents[2]
COMPILER = shutil.which("g++")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no g++ here: the C++ header is not tested")
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Werror"]

OPTIONS = [
    "mass", "rate", "max_step", "force_limit", "deadband", "spring_limit", "velocity_limit", "acceleration_limit",
    "hold_ticks", "max_bad_ticks", "stop_deceleration", "soft_start", "approach_speed", "on_gap", "force_rate_limit",
]  # fmt: skip
ROUNDING = 1e-12


def compiled(source, *options):
    """Path of what g++ makes of a source in this folder."""
    path = Path(tempfile.mkdtemp(prefix="torch_pbd_cpp")) / "program"
    command = [COMPILER, "-std=c++17", *WARNINGS, f"-I{ROOT / 'cpp'}", *options]
    ran = subprocess.run([*command, str(source), "-o", str(path)], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return path


@functools.cache
def _library():
    """Library of this folder, or why it is not there: it is compiled once, in any case."""
    try:
        path = compiled(Path(__file__).with_name("bridge.cpp"), "-O1", "-shared", "-fPIC")
    except AssertionError as error:
        return error
    loaded = ctypes.CDLL(str(path))
    shutil.rmtree(path.parent)
    numbers = POINTER(c_double)
    for name, result, arguments in [
        ("create", c_void_p, [c_char_p, numbers, c_char_p]),
        ("read_array", c_long, [c_char_p, c_char_p, numbers, c_char_p]),
        ("destroy", None, [c_void_p]),
        ("start", c_bool, [c_void_p, c_double, numbers, numbers, c_double, numbers, c_char_p]),
        ("tick", c_uint, [c_void_p, c_double, numbers, numbers]),
    ]:
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


def library():
    """Functions of `bridge.cpp`."""
    loaded = _library()
    assert isinstance(loaded, ctypes.CDLL), loaded
    return loaded


def read_array(path, name):
    """Values of an array of a file as C++ reads them, flat; None where it has none."""
    text = create_string_buffer(500)
    size = library().read_array(bytes(path), name.encode(), None, text)
    if text.value:
        raise ValueError(text.value.decode())
    values = (c_double * size)()
    library().read_array(bytes(path), name.encode(), values, text)
    return np.array(values) if size else None


class CppAdmittance:
    """`torch_pbd::Admittance` with the names of `RealTimeAdmittance`."""

    def __init__(self, path, n_axes, *, is_pose=False, **options):
        assert set(options) <= set(OPTIONS)
        options = {**options, "on_gap": float(options.get("on_gap") == "resume")}
        values = [np.resize(math.nan if options.get(name) is None else options[name], 2) for name in OPTIONS]
        self._library, self._text = library(), create_string_buffer(500)
        self._d, self._m = d, m = n_axes, n_axes + is_pose
        self._twist, self._place = c_double * d, c_double * m
        self._loop = self._library.create(bytes(path), (c_double * (2 * len(values)))(*np.ravel(values)), self._text)
        self._check(self._loop)
        self._n_told = 1 + 3 * d + 2 * m
        self._force, self._out = self._twist(), (c_double * (self._n_told + 2 * d * d))()

    def __del__(self):
        if getattr(self, "_loop", None):
            self._library.destroy(self._loop)

    def start(self, now, position=None, velocity=None, *, orientation=None, at=0.0, force_bias=None):
        p = self._d - 3 * (self._m > self._d)
        place = [math.nan] * p if position is None else [*position]
        if self._m > self._d:
            place += [math.nan] * 4 if orientation is None else [*orientation]
        given = [None if each is None else self._twist(*each) for each in (velocity, force_bias)]
        self._check(self._library.start(self._loop, now, self._place(*place), given[0], at, given[1], self._text))

    def tick(self, now, force):
        self._force[:] = force
        return self._library.tick(self._loop, now, self._force, self._out)

    @property
    def told(self):
        """Schedule time, place, velocity, force, desired place and velocity of the last tick."""
        return self._out[: self._n_told]

    @property
    def gains(self):
        """Stiffness and damping of the last tick, (2, d, d)."""
        return np.reshape(self._out[self._n_told :], (2, self._d, self._d))

    def _check(self, succeeded):
        if not succeeded:
            raise ValueError(self._text.value.decode())


class Both:
    """The two controllers, which must say the same in each tick; a `RealTimeAdmittance` for those who ask."""

    def __init__(self, schedule, folder, **options):
        path = Path(folder) / "schedule.csv"
        schedule.save(path)
        self.is_pose, d, p = schedule.orientation is not None, schedule.n_outputs, schedule.position.shape[1]
        self.python = RealTimeAdmittance(schedule, **options)
        self.cpp = CppAdmittance(path, d, is_pose=self.is_pose, **options)
        # Lengths, angles and speeds are compared with the largest of the motion, forces with the largest force.
        reach, speed = np.abs(schedule.position).max(), np.abs(schedule.velocity).max()
        sizes = [1, p, 4 * self.is_pose, d, d, p, 4 * self.is_pose, d]
        self._scales = np.repeat([schedule.duration, reach, 1.0, speed, 1.0, reach, 1.0, speed], sizes)
        self.worst, self.seen = 0.0, TickStatus(0)

    def __getattr__(self, name):
        return getattr(self.python, name)

    def start(self, *arguments, **options):
        self.python.start(*arguments, **options)
        self.cpp.start(*arguments, **options)

    def tick(self, now, force):
        status, faults = self.python.tick(now, force), self.cpp.tick(now, force)
        assert faults == status, f"at {now}"
        self.seen |= status
        loop, cpp = self.python, self.cpp.told
        told = [loop.schedule_time, *loop.position, *(loop.orientation if self.is_pose else ())]
        told += [*loop.velocity, *loop.force, *loop.desired_position]
        told += [*(loop.desired_orientation if self.is_pose else ()), *loop.desired_velocity]
        for i, (left, right) in enumerate(zip(told, cpp, strict=True)):
            scale = self._scales[i] = max(self._scales[i], abs(left))
            self.worst = max(self.worst, abs(left - right) / scale)
        assert self.worst <= ROUNDING, f"at {now}: {told} and {cpp}"
        return status
