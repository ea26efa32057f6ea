"""A playground of this machine."""

import signal
import subprocess
import sys

import pytest


@pytest.fixture(scope="module")
def address():
    """Address of a playground that the command line has begun; Ctrl-C ends it, and its learning process."""
    pytest.importorskip("uvicorn", reason="the extra 'playground' is not installed")
    command = [sys.executable, "-m", "torch_pbd.cli.main", "playground", "--browse", "false"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        yield run.stdout.readline().split()[1]
        run.send_signal(signal.SIGINT)
        said, errors = run.communicate(timeout=30)
        assert run.returncode == 0
        assert said.endswith("\nplayground: ended.\n")
        assert not errors
