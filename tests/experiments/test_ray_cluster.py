"""A Ray cluster that outlap begins ends with the work, and with Ctrl-C at any moment."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("ray", reason="needs Ray: pip install 'outlap[distributed]'")

import ray

from outlap.experiments.ray_cluster import MARK, ray_cluster

linux = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="elsewhere Ray sees to its processes")


@pytest.fixture
def usual_handler() -> Iterator[None]:
    """A test run in the background hands down an ignored SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@linux
@pytest.mark.usefixtures("usual_handler")
def test_ctrl_c_comes_while_ray_begins_though_ray_passes_over_it(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[subprocess.Popen[bytes]] = []
    released, order = threading.Event(), []

    def init(**_: Any) -> None:
        begun.append(subprocess.Popen(["sleep", "600"]))
        with suppress(KeyboardInterrupt):  # as Python does in a fork
            os.kill(os.getpid(), signal.SIGINT)
            released.wait(5.0)  # as Ray waits for its processes in C++
        order.append("first is over")

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(KeyboardInterrupt), ray_cluster("local"):
        pass
    assert begun[0].wait(timeout=30.0) == -signal.SIGKILL
    monkeypatch.setattr(ray, "init", lambda **_: order.append("second"))
    released.set()
    with ray_cluster("local"):
        assert order == ["first is over", "second"]
        assert MARK not in os.environ


SCRIPT = """
import subprocess
import sys
import ray
from outlap.experiments.ray_cluster import ray_cluster

@ray.remote(num_cpus=0)
def work():
    subprocess.Popen(["sleep", "600"])

JOINS = "from outlap.experiments.ray_cluster import ray_cluster\\nwith ray_cluster({!r}): pass"

with ray_cluster("local"):
    address = ray.get_runtime_context().gcs_address
    subprocess.run([sys.executable, "-c", JOINS.format(address)], check=True)  # and leaves it as it is
    ray.get(work.remote())
    print(ray.is_initialized())
print(ray.is_initialized())
"""


@linux
@pytest.mark.slow
def test_none_of_its_processes_outlives_a_cluster(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT], cwd=tmp_path, start_new_session=True, stdout=subprocess.PIPE, text=True
    )
    said, _ = process.communicate(timeout=100.0)
    assert said.split() == ["True", "False"]
    assert running(process.pid) == []


def running(session: int) -> list[str]:
    """Names of the processes of a session that run."""
    names = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # gone
            name, _, rest = path.read_text().rpartition(")")
            state, _, _, its, *_ = rest.split()
            if int(its) == session and state != "Z":
                names.append(name)
    return names
