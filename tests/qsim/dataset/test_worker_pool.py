"""Worker processes: the same bytes for any number; a crash, a removed folder, a killed parent."""

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from fakes import (
    RECIPE,
    SMALL,
    SUPPORT,
    crash_on_tumble,
    hoard_on_tumble,
    make,
    make_slowly,
    tree,
    wait_for,
)

from qsim import files
from qsim.dataset import recipe
from qsim.dataset.dataset import Dataset
from qsim.dataset.generation import Options, generate
from qsim.dataset.job_runner import RenderJob
from qsim.dataset.worker_pool import Limits


@pytest.mark.parametrize("options", [Options(workers=1), Options(workers=2, limits=Limits(jobs=1))])
def test_any_number_of_workers_gives_the_same_bytes(tmp_path: Path, undisturbed: dict[str, bytes], options: Options):
    assert generate(SMALL, tmp_path / "d", options, make=make).made == 3
    assert tree(tmp_path / "d") == undisturbed


def test_a_killed_parent_leaves_no_workers_and_its_folder_resumes(tmp_path: Path, undisturbed: dict[str, bytes]):
    folder = tmp_path / "d"
    code = "import sys; from fakes import *; from qsim.dataset import recipe; from qsim.dataset.generation import *;"
    code += "generate(recipe.parse(RECIPE), sys.argv[1], Options(workers=2), make=make_slowly)"
    env = os.environ | {"PYTHONPATH": SUPPORT}
    parent = subprocess.Popen([sys.executable, "-c", code, str(folder)], env=env)
    wait_for(lambda: len(list((folder / "logs").glob("*"))) == 2)
    parent.kill()
    parent.wait()
    assert generate(SMALL, folder, Options(workers=1), make=make_slowly).done == 3
    assert tree(folder) == undisturbed


@pytest.mark.parametrize(
    ("maker", "why"),
    [(crash_on_tumble, "signal SIGKILL"), (hoard_on_tumble, "more memory than is allowed")],
)
def test_a_crashing_worker_takes_down_only_its_job(tmp_path: Path, maker: RenderJob, why: str):
    options = Options(workers=2, limits=Limits(memory=0.7))
    summary = generate(SMALL, tmp_path / "d", options, make=maker)
    assert summary.done == 2
    assert list(summary.failed) == ["tumble_0004"]
    assert "crashed 2 times" in summary.failed["tumble_0004"]
    assert why in summary.failed["tumble_0004"]


@pytest.mark.parametrize("part", [None, *(pytest.param(part, marks=pytest.mark.slow) for part in ("locks", "jobs"))])
def test_a_folder_that_is_removed_while_workers_write(tmp_path: Path, part: str | None, capfd):
    """One line, no worker's traceback; the rest is a data set for the next run, which makes the same files."""
    wanted = recipe.parse(RECIPE.replace("[0, 1]", "[0, 1, 2, 3, 5, 6]"))
    folder = tmp_path / "d"
    stop = threading.Event()

    def remove() -> None:
        while not stop.is_set():  # like `rm -r`, repeated until nothing is left
            if any((folder / "logs").glob("*")):
                shutil.rmtree(folder / part if part else folder, ignore_errors=True)
            stop.wait(0.02)

    thread = threading.Thread(target=remove)
    thread.start()
    try:
        with pytest.raises(FileNotFoundError) as caught:
            generate(wanted, folder, Options(workers=2), make=make_slowly)
    finally:
        stop.set()
        thread.join()
    assert str(folder) in files.wording(caught.value)
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    assert generate(wanted, folder, Options(workers=0, retry=True), make=make).failed == {}
    assert Dataset.open(folder).verify() == []
