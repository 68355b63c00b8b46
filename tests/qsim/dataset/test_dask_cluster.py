"""Dask scheduler and workers in separate processes: one worker is killed, one lacks a resource."""

import os
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from fakes import RECIPE, SUPPORT, fail_on_tumble, make, make_slowly, make_with_pause, tree, wait_for

import qsim.cli.program
from qsim.dataset import generation, recipe
from qsim.dataset.dask_cluster import Cluster, task_key
from qsim.dataset.generation import Options, generate
from qsim.dataset.job_runner import Result
from qsim.dataset.worker_pool import Limits

distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
TESTS = Path(__file__).parents[2]
PAGE = TESTS.parent / "docs" / "cluster.md"
THREE = recipe.parse(RECIPE)
SMALL = recipe.parse(RECIPE.replace("seeds = [0, 1]", "seeds = [0, 1, 2, 3, 4, 5]"))
PATIENCE = 300.0  # seconds; on a busy machine a worker needs half a minute to start


class LocalCluster:
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
        env = os.environ | {"PYTHONPATH": SUPPORT}
        with open(place / "log", "wb") as log:
            line = [sys.executable, "-m", "dask", *command]
            process = subprocess.Popen(line, cwd=place, env=env, stdout=log, stderr=log)
        self.processes.append(process)
        return process

    def worker(self, *options: str) -> subprocess.Popen[bytes]:
        """Start a worker that runs its jobs in the process returned, to which ids and kills refer."""
        return self.start("worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", *options)

    def wait_for_workers(self, count: int) -> None:
        with distributed.Client(self.address, timeout=PATIENCE) as client:
            client.wait_for_workers(count, timeout=PATIENCE)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[LocalCluster]:
    started = LocalCluster(tmp_path)
    yield started
    for process in started.processes:
        process.kill()
        process.wait()


def processes(folder: Path) -> dict[str, list[int]]:
    """Return job -> ids of the processes in its log, in order: one per start of its rendering, one for its end."""
    logs = sorted((folder / "logs").glob("*.log"))
    return {log.stem: [int(word) for word in re.findall(r"process (\d+)", log.read_text())] for log in logs}


def half_done(folder: Path) -> dict[int, str]:
    """Return process -> its job, for jobs that have a finished frame and miss others."""
    return {
        ids[-1]: job
        for job, ids in processes(folder).items()
        if ids and (folder / "work" / f"{job}.part" / "journal.jsonl").is_file()
    }


@pytest.mark.slow
def test_a_killed_workers_job_is_finished_by_the_other_and_gives_the_files_of_a_local_run(
    tmp_path: Path, cluster: LocalCluster
):
    generate(SMALL, tmp_path / "local", Options(workers=0), make=make)
    first = cluster.worker()
    second = cluster.worker()
    folder = tmp_path / "far"
    folder.mkdir()
    with ThreadPoolExecutor() as pool:
        far = pool.submit(generate, SMALL, folder, make=make_with_pause, run=Cluster(cluster.address, timeout=PATIENCE))
        try:
            wait_for(lambda: first.pid in half_done(folder), PATIENCE)
            job = half_done(folder)[first.pid]
            frame = (folder / "work" / f"{job}.part" / "radiance" / "000000.exr").stat()
            first.kill()
            first.wait()
        finally:
            (folder / "go").touch()
        summary = far.result(timeout=PATIENCE)
    assert (summary.made, summary.failed) == (7, {})
    assert processes(folder).pop(job) == [first.pid, second.pid, second.pid]
    assert all(ids == [second.pid] * 2 for name, ids in processes(folder).items() if name != job)
    kept = (folder / "clips" / job / "radiance" / "000000.exr").stat()
    assert (kept.st_ino, kept.st_mtime_ns) == (frame.st_ino, frame.st_mtime_ns), "the frame was rendered again"
    assert tree(folder) == tree(tmp_path / "local")


@pytest.mark.slow
def test_a_killed_scheduler_is_one_sentence_and_no_job_has_failed(tmp_path: Path, cluster: LocalCluster):
    generate(SMALL, tmp_path / "local", Options(workers=0), make=make)
    worker = cluster.worker()
    folder = tmp_path / "far"
    folder.mkdir()
    with ThreadPoolExecutor() as pool:
        far = pool.submit(generate, SMALL, folder, make=make_with_pause, run=Cluster(cluster.address, timeout=PATIENCE))
        wait_for(lambda: worker.pid in half_done(folder), PATIENCE)
        cluster.processes[0].kill()
        with pytest.raises(ConnectionError, match="its Dask scheduler is gone; nothing is lost: start one and run"):
            far.result(timeout=PATIENCE)
    worker.kill()
    worker.wait()
    assert not list((folder / "failed").iterdir())
    assert generate(SMALL, folder, Options(workers=0), make=make).failed == {}
    assert tree(folder) == tree(tmp_path / "local")


@pytest.mark.slow
def test_folders_of_one_name_on_one_scheduler_do_not_get_each_others_results(tmp_path: Path, cluster: LocalCluster):
    """The second client starts while the first still holds all of its jobs, which have the same names."""
    cluster.worker()
    run = Cluster(cluster.address, timeout=PATIENCE)
    later = []

    def start_the_second(_: Result) -> None:
        if not later:
            later.append(generate(SMALL, tmp_path / "b" / "d", make=make, run=run))

    first = generate(SMALL, tmp_path / "a" / "d", make=make, run=run, on_result=start_the_second)
    assert [(summary.done, summary.made) for summary in (first, *later)] == [(7, 7), (7, 7)]
    assert tree(tmp_path / "a" / "d") == tree(tmp_path / "b" / "d")


def test_a_key_names_folder_and_job_and_differs_with_the_whole_path_and_the_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    job = SMALL.jobs[0]
    key = task_key(tmp_path / "a" / "d", job)
    assert key.startswith("d-fan_0000-")
    other = replace(job, settings=replace(job.settings, psnr=41.0))
    assert len({key, task_key(tmp_path / "b" / "d", job), task_key(tmp_path / "a" / "d", other)}) == 3
    monkeypatch.chdir(tmp_path)
    assert task_key(Path("b/../a/d"), job) == key


@pytest.mark.slow
def test_failures_on_the_cluster_are_listed(tmp_path: Path, cluster: LocalCluster):
    cluster.worker()
    summary = generate(SMALL, tmp_path / "d", make=fail_on_tumble, run=Cluster(cluster.address, timeout=PATIENCE))
    assert summary.failed == {"tumble_0004": "scene tumble: no light and no glowing body"}
    assert summary.done == 6


@pytest.mark.slow
def test_a_worker_without_the_resource_gets_no_job(tmp_path: Path, cluster: LocalCluster):
    """It is idle all the time, while the other has more jobs than it can run at once."""
    plain = cluster.worker()
    gifted = cluster.worker("--resources", "GPU=1")
    cluster.wait_for_workers(2)
    run = Cluster(cluster.address, gpus=1, timeout=PATIENCE)
    assert generate(SMALL, tmp_path / "d", make=make_slowly, run=run).made == 7
    assert plain.poll() is None
    assert processes(tmp_path / "d") == {job.name: [gifted.pid] * 2 for job in SMALL.jobs}


def page_options() -> list[str]:
    """Return the options of the first worker in docs/cluster.md."""
    found = re.search(r"^dask worker tcp://HOST:8786 (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert found
    return shlex.split(found[1], comments=True)


@pytest.mark.slow
def test_a_worker_started_as_the_page_says_is_replaced_and_its_jobs_are_done(tmp_path: Path, cluster: LocalCluster):
    """Its first job ends after its lifetime, so that the process that replaces it runs the others."""
    options = page_options()
    assert "--memory-limit" in options
    assert "--lifetime-restart" in options
    short = {"1h": "5s", "10m": "0s"}
    assert short.keys() <= set(options)
    cluster.start("worker", cluster.address, "--no-dashboard", *(short.get(word, word) for word in options))
    log = tmp_path / "process1" / "log"
    folder = tmp_path / "far"
    folder.mkdir()
    with ThreadPoolExecutor() as pool:
        far = pool.submit(generate, THREE, folder, make=make_with_pause, run=Cluster(cluster.address, timeout=PATIENCE))
        try:
            wait_for(lambda: bool(half_done(folder)), PATIENCE)
            ((process, held),) = half_done(folder).items()
            ends = log.read_text().count("lifetime-reached")
            wait_for(lambda: log.read_text().count("lifetime-reached") > ends, PATIENCE)
        finally:
            (folder / "go").touch()
        summary = far.result(timeout=PATIENCE)
    assert (summary.made, summary.failed) == (3, {})
    assert processes(folder)[held][0] == process
    assert all(process not in ids for job, ids in processes(folder).items() if job != held)
    generate(THREE, tmp_path / "local", Options(workers=0), make=make)
    assert tree(folder) == tree(tmp_path / "local")


def test_nobody_at_the_address(tmp_path: Path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        with pytest.raises(ValueError, match=f"{address}: no Dask scheduler answers there"):
            generate(SMALL, tmp_path / "d", make=make, run=Cluster(address, timeout=0.5))


@pytest.fixture
def options_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Options]:
    """Write r.toml and make `qsim generate` only record its options."""
    (tmp_path / "r.toml").write_text(RECIPE)
    monkeypatch.chdir(tmp_path)
    used: list[Options] = []

    def note(wanted: recipe.Recipe, folder: Path, options: Options, run: object) -> generation.Summary:
        used.append(options)
        return generation.Summary(3, 3, 3, {}, ())

    monkeypatch.setattr(generation, "generate", note)
    return used


@pytest.mark.parametrize(
    ("given", "named", "instead"),
    [
        ("--workers 4", "--workers", "--nworkers"),
        ("--workers 1", "--workers", "--nworkers"),  # the default, but given
        ("--memory 8", "--memory", "--memory-limit"),
        ("--memory 4.0", "--memory", "--memory-limit"),
        ("--workers 4 --memory 8", "--workers", "--nworkers"),
    ],
)
def test_options_of_local_processes_are_refused_with_a_cluster(
    options_used: list[Options], capsys: pytest.CaptureFixture[str], given: str, named: str, instead: str
):
    words = ["generate", "r.toml", *given.split(), "--cluster", "tcp://127.0.0.1:1"]
    assert qsim.cli.program.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"qsim: {named}: ")
    assert "--cluster" in line
    assert f"`dask worker {instead}`" in line
    assert options_used == []


def test_options_that_are_not_given_are_the_defaults(options_used: list[Options]):
    assert qsim.cli.program.main(["generate", "r.toml", "--cluster", "tcp://127.0.0.1:1"]) == 0
    assert qsim.cli.program.main(["generate", "r.toml"]) == 0
    assert qsim.cli.program.main(["generate", "r.toml", "--workers", "3", "--memory", "8"]) == 0
    assert options_used == [Options(), Options(), Options(workers=3, limits=Limits(memory=8))]


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("--gpus 1", "needs --cluster"),
        ("--gpus -1", "expected a number from 0"),
        ("--gpus nan", "expected a number from 0"),
    ],
)
def test_gpus_are_the_clusters(options_used: list[Options], capsys: pytest.CaptureFixture[str], given: str, text: str):
    assert qsim.cli.program.main(["generate", "r.toml", *given.split()]) == 2
    assert text in capsys.readouterr().err


def test_a_scheduler_without_tls_is_named(options_used: list[Options], capsys: pytest.CaptureFixture[str]):
    """A scheduler accepts pickled work from every client; the warning comes before anything is sent."""
    assert qsim.cli.program.main(["generate", "r.toml", "--cluster", "tcp://127.0.0.1:1"]) == 0
    assert (
        "tcp://127.0.0.1:1: without TLS, so anyone who can reach this port can run any program"
        in capsys.readouterr().err
    )
    assert qsim.cli.program.main(["generate", "r.toml", "--cluster", "tls://127.0.0.1:1"]) == 0
    assert "TLS" not in capsys.readouterr().err
