"""A Dask scheduler and two workers in processes and folders of their own, one of which is killed in the middle."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fakes import RECIPE, fail_on_tumble, make, make_slowly, tree

from qsim import recipe
from qsim.cluster import Cluster
from qsim.generation import Options, generate

pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
TESTS = Path(__file__).parents[1]
PYTHONPATH = f"{TESTS.parent}{os.pathsep}{TESTS}"  # the package first: tests/qsim is no package
SMALL = recipe.parse(RECIPE.replace("seeds = [0, 1]", "seeds = [0, 1, 2, 3, 4, 5]"))


class Crew:
    """A scheduler and workers of this test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self.processes: list[subprocess.Popen[bytes]] = []
        self.start("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        place = self.folder / f"process{len(self.processes)}"
        place.mkdir()
        env = os.environ | {"PYTHONPATH": PYTHONPATH}
        with open(place / "log", "wb") as log:
            line = [sys.executable, "-m", "dask", *command]
            process = subprocess.Popen(line, cwd=place, env=env, stdout=log, stderr=log)
        self.processes.append(process)
        return process

    def worker(self, *options: str) -> subprocess.Popen[bytes]:
        return self.start("worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", *options)


@pytest.fixture
def crew(tmp_path: Path) -> Iterator[Crew]:
    started = Crew(tmp_path)
    yield started
    for process in started.processes:
        process.kill()
        process.wait()


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.mark.slow
def test_two_workers_one_of_them_killed_give_the_files_of_a_local_run(tmp_path: Path, crew: Crew):
    generate(SMALL, tmp_path / "local", Options(workers=0), make=make)
    first = crew.worker()
    crew.worker()
    folder = tmp_path / "far"
    killed = []

    def kill_one(_: object) -> None:
        if not killed:
            killed.append(first)
            first.kill()

    summary = generate(SMALL, folder, make=make_slowly, run=Cluster(crew.address, timeout=60), on_result=kill_one)
    assert killed
    assert (summary.made, summary.failed) == (7, {})
    assert tree(folder) == tree(tmp_path / "local")


@pytest.mark.slow
def test_failures_on_the_cluster_are_listed(tmp_path: Path, crew: Crew):
    crew.worker("--resources", "GPU=1")
    run = Cluster(crew.address, gpus=1, timeout=60)
    summary = generate(SMALL, tmp_path / "d", make=fail_on_tumble, run=run)
    assert summary.failed == {"tumble_0004": "scene tumble: no light and no glowing body"}
    assert summary.done == 6


def test_nobody_at_the_address(tmp_path: Path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        with pytest.raises(ValueError, match=f"{address}: no Dask scheduler answers there"):
            generate(SMALL, tmp_path / "d", make=make, run=Cluster(address, timeout=0.5))
