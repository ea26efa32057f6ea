"""Memory that there is, as files of the system tell it, and what refuses to go beyond."""

import json
import os
import tracemalloc

import numpy as np
import pytest
import torch

import torch_pbd.files.memory
from torch_pbd import CholeskyCovRegressor
from torch_pbd.control import AdmittancePlant, DMPController, EnergyTank
from torch_pbd.data import make_tunnel_demonstrations
from torch_pbd.files.memory import available_bytes, parsed_bytes, require_memory

GIB = 2**30


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A machine of 64 GiB; writes the files by which it tells the limits of groups."""
    monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 64 * GIB // 4096}.__getitem__)
    monkeypatch.setattr(torch_pbd.files.memory, "_CONTROL_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(torch_pbd.files.memory, "_MOUNT", tmp_path / "mount")

    def write(groups, limits):
        (tmp_path / "cgroup").write_text(groups)
        for path, limit in limits.items():
            file = tmp_path / "mount" / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(f"{limit}\n")

    return write


@pytest.mark.parametrize(
    ("groups", "limits", "expected"),
    [
        ("0::/\n", {}, 64),
        ("0::/\n", {"memory.max": "max"}, 64),
        ("0::/\n", {"memory.max": 3 * GIB}, 3),
        ("0::/job/step\n", {"job/step/memory.max": "max", "job/memory.max": 5 * GIB}, 5),
        ("0::/job/step\n", {"job/step/memory.max": 2 * GIB, "job/memory.max": 5 * GIB}, 2),
        ("0::/outside\n", {"memory.max": 7 * GIB}, 7),  # a container that sees its own group as the root
        ("0::/job\n", {"job/memory.max": 100 * GIB}, 64),
        ("4:cpu,cpuacct:/a\n3:memory:/a\n", {"memory/a/memory.limit_in_bytes": 6 * GIB}, 6),
        ("3:memory:/a\n", {"memory/a/memory.limit_in_bytes": 2**63 - 4096}, 64),
        ("4:cpu:/a\n", {"memory/a/memory.limit_in_bytes": GIB}, 64),
    ],
)
def test_the_lowest_limit_of_machine_and_groups_holds(system, groups, limits, expected):
    system(groups, limits)
    assert available_bytes() == expected * GIB


def test_without_groups_it_is_the_machine(system):
    assert available_bytes() == 64 * GIB


def test_a_system_that_does_not_tell_sets_no_limit(system, monkeypatch):
    monkeypatch.delattr(os, "sysconf")
    require_memory(2**50, what="this", remedy="")


def test_the_message_has_both_numbers_and_the_remedy(monkeypatch):
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 10 * GIB)
    require_memory(8 * GIB, what="this", remedy="")
    with pytest.raises(ValueError, match=r"^a sum needs about 8\.5 GiB of memory, but 8 GiB can be used here\. Add\.$"):
        require_memory(8.5 * GIB, what="a sum", remedy="Add.")


def test_an_hour_at_1_khz_is_refused_where_it_does_not_fit(monkeypatch):
    controller = DMPController(CholeskyCovRegressor(), n_steps=20).fit(
        make_tunnel_demonstrations(rate=10.0, random_state=0)
    )
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: GIB)
    with pytest.raises(ValueError, match=r"3600001 ticks of 2 axes needs about 1\.45 GiB .* Lower rate"):
        controller.schedule(1000.0, settle=3600.0 - controller.duration_)
    assert len(controller.schedule(100.0)) == 1001


def test_a_schedule_is_the_same_in_parts(monkeypatch):
    controller = DMPController(CholeskyCovRegressor(), n_steps=20).fit(
        make_tunnel_demonstrations(rate=10.0, random_state=0)
    )
    whole = controller.schedule(50.0)
    monkeypatch.setattr("torch_pbd.estimators.door._CHUNK", 64)
    parts = controller.schedule(50.0)
    for name in ("stiffness", "damping", "covariance", "type1"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-10, atol=1e-14)
    assert controller.predict_stiffness(np.empty((0, 1))).shape == (0, 2, 2)


def test_trajectories_that_do_not_fit_are_refused(monkeypatch):
    still, gains = torch.zeros(50, 2).double(), torch.eye(2).double().expand(50, 2, 2)
    force = torch.zeros(1000, 1, 1).double().expand(1000, 50, 2)
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 8 * 10**6)  # 0.8 of it: 128 bytes a tick
    assert AdmittancePlant().simulate(still, still, gains, gains, force, dt=0.01).position.shape == (1000, 50, 2)
    plant = AdmittancePlant(stiffness_filter=EnergyTank())
    with pytest.raises(ValueError, match=r"1000 rollouts of 50 ticks needs .* or take simulate_many"):
        plant.simulate(still, still, gains, gains, force, dt=0.01)


@pytest.mark.parametrize("text", ["1000,", "0.12345678,", "[],", '{"a":1},', '"ab",', "[[1.5,2.5],[3.5,4.5]],"])
def test_what_parsed_text_takes_is_not_underestimated(text):
    content = f"[{30_000 * text}0]".encode()
    tracemalloc.start()
    try:
        json.loads(content.decode())
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.2 < taken / parsed_bytes([content]) < 1.0
    assert parsed_bytes([content[:1000], content[1000:]]) == parsed_bytes([content])
