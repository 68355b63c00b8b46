"""The number of threads: chosen by measurement or by option, recorded, kept; and it changes no result."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from clips import ClipMaker, write_clip
from compiled_cases import loaded_drjit

import qsim.cli.program
from qsim.streams import storing
from quiver import threads
from quiver.cli import program
from quiver.model.unet import UNet, UNetConfig
from quiver.restoration.restored_file import Unfinished
from quiver.training.loop import train
from quiver.training.settings import Settings

ROOT = Path(__file__).parents[2]
two_cores = pytest.mark.skipif(threads.cores() < 2, reason="needs two cores")


@pytest.fixture(autouse=True)
def as_before():
    number = torch.get_num_threads()
    threads.measured.cache_clear()
    yield
    torch.set_num_threads(number)
    threads.measured.cache_clear()


@two_cores
@pytest.mark.parametrize("slow_one", [1, 2])
def test_the_faster_number_is_kept(monkeypatch, slow_one):
    """A convolution that takes a millisecond more with one of the two numbers."""
    plain = torch.nn.functional.conv2d

    def slowed(*args: object, **kwargs: object) -> torch.Tensor:
        if torch.get_num_threads() == slow_one:
            time.sleep(0.02)
        return torch.zeros(1) if args else plain(*args, **kwargs)

    monkeypatch.setattr(torch.nn.functional, "conv2d", slowed)
    torch.set_num_threads(2)
    chosen = threads.use()
    assert chosen.number == torch.get_num_threads() == 3 - slow_one
    assert "measured" in str(chosen)
    torch.set_num_threads(slow_one)
    assert threads.use().number == 3 - slow_one, "once per process"


@two_cores
def test_told_before_earlier_before_measured():
    torch.set_num_threads(1)
    assert threads.use(2, 1) == threads.Threads(2, "as asked for")
    assert threads.use(None, 2).number == torch.get_num_threads() == 2
    assert threads.use(None, 10**9).number == threads.cores()
    torch.set_num_threads(1)
    assert threads.use().number == 1


@pytest.mark.parametrize("wanted", [0, -1, 10**9])
def test_impossible_numbers_are_refused(wanted):
    with pytest.raises(ValueError, match=rf"threads={wanted}: this machine has \d+ cores; give 1 to"):
        threads.use(wanted)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"threads": 0}', '{"threads": "2"}', '{"threads": true}'])
def test_what_names_no_number_is_no_number(tmp_path, content):
    (tmp_path / "a.json").write_text(content)
    assert threads.recorded(tmp_path / "a.json") is None
    assert threads.recorded(tmp_path / "none.json") is None
    (tmp_path / "a.json").write_text('{"threads": 2}')
    assert threads.recorded(tmp_path / "a.json") == 2


COMPARE = """
import sys
import numpy as np
import torch
from quiver.data.code_table import draw_codes
from quiver.data.codes import array_codes
from quiver.data.illumination import Illumination
from qsim.keys import Key
from quiver.model.presets import build
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import wrap_network
from quiver.restoration.restorers import method_names, restorer

torch.manual_seed(0)
sensor = Illumination().device(5e-4)
photons = np.random.default_rng(0).uniform(0.5, 6.0, (12, 16, 20))
codes = array_codes(draw_codes(sensor, photons, 5e-4, Key(1, 2)), sensor, 5e-4)
options = RestoreOptions()
names = method_names() if "all" in sys.argv else sys.argv[1:]
for name in names:
    preset = name in ("unet", "quiver-s", "quiver")
    method = wrap_network(build(name), name, "random weights", options) if preset else restorer(name, options)
    pictures = []
    for number in (1, 2):
        torch.set_num_threads(number)
        pictures.append(method.restore(codes, 5, 6) / codes.white)
    print(method.name, float(np.abs(pictures[1] - pictures[0]).max()))
"""


@two_cores
@pytest.mark.parametrize(
    "methods",
    ["mergenet unet moment", *(pytest.param(more, marks=pytest.mark.slow) for more in ("all", "quiver-s quiver"))],
)
def test_restored_video_does_not_depend_on_the_number(methods):
    """Every classical method and the shipped networks, and untrained presets: within 1e-5 of white."""
    words = [sys.executable, "-c", COMPARE, *methods.split()]
    alone = os.environ | {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "2"}
    done = subprocess.run(words, cwd=ROOT, env=alone, capture_output=True, text=True, check=True)
    found = {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in done.stdout.splitlines()}
    named = {"naive", "qbp", "qbp-bm3d", "likelihood", "mergenet"} if methods == "all" else set(methods.split())
    assert named <= found.keys()
    assert max(found.values()) < 1e-5, found


@two_cores
def test_a_run_keeps_its_number_unless_told_otherwise(tiny_dataset, tmp_path):
    def again(**told: int) -> int:
        torch.manual_seed(0)
        mine = Settings(str(tiny_dataset), str(tmp_path / "r"), steps=1, crop=16, batch=1, validation_windows=1, **told)
        with mock.patch.object(torch, "set_num_threads", wraps=torch.set_num_threads) as asked:
            train(UNet(UNetConfig(1)), mine, progress=False)
        written = json.loads((tmp_path / "r/settings.json").read_text())["threads"]
        assert [call.args[0] for call in asked.call_args_list] == [written, 1]  # during the run, and after it
        return written

    torch.set_num_threads(1)
    assert again(threads=2) == 2
    assert again() == 2
    assert again(threads=1) == 1
    with pytest.raises(ValueError, match="threads=1000000: this machine has"):
        again(threads=10**6)


@two_cores
def test_restored_video_notes_its_number(make_clip: ClipMaker, tmp_path, capsys):
    """A resumed restoration takes the number in its journal."""
    words = ["restore", make_clip().path, "-o", tmp_path / "v.npy", "--method", "moment", "--ppp", 3.25, "--force"]

    def noted(*more: object) -> int:
        assert program.main([str(word) for word in [*words, *more]]) == 0
        capsys.readouterr()
        return json.loads((tmp_path / "v.json").read_text())["threads"]

    assert noted("--threads", 2) == 2
    assert noted("--threads", 1) == 1
    (tmp_path / "v.npy.part.json").write_text(json.dumps({"format": Unfinished.FORMAT, "threads": 2}))
    assert noted() == 2


def test_verbose_says_the_number_and_a_wrong_one_is_one_line(make_clip: ClipMaker, tmp_path, capsys):
    words = ["restore", str(make_clip().path), "-o", str(tmp_path / "v.npy"), "--method", "moment", "--ppp", "3"]
    assert program.main([*words, "--threads", "1000"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert program.main([*words, "--threads", "1", "-v"]) == 0
    assert f"threads: 1 of {threads.cores()} (as asked for)" in capsys.readouterr().err


def test_every_command_that_computes_has_the_option(capsys):
    quiver_commands = ("train", "restore", "evaluate", "ablate", "bench")
    qsim_commands = ("render", "sense", "generate", "plan", "tradeoff", "validate")
    for main, names in ((program.main, quiver_commands), (qsim.cli.program.main, qsim_commands)):
        for name in names:
            main([name, "--help"])
            assert "--threads" in capsys.readouterr().out, name


@two_cores
def test_the_compiled_engine_has_as_many_and_the_next_command_all(tmp_path, monkeypatch, capsys):
    """Inside the command Dr.Jit and its child processes have the number; after it, the number from before."""
    drjit = loaded_drjit()
    before = drjit.thread_count()
    seen = []
    plain = storing.sense

    def watched(*args: object, **kwargs: object) -> object:
        seen.append((os.environ.get("QSIM_THREADS"), drjit.thread_count()))
        return plain(*args, **kwargs)

    monkeypatch.setattr(storing, "sense", watched)
    clip = write_clip(tmp_path / "c", frames=3, height=96, width=96)
    for name, more in (("one", ["--threads", "1"]), ("all", [])):
        assert qsim.cli.program.main(["sense", str(clip.path), "--ppp", "3", "--bits", "3", "-o", name, *more]) == 0
    assert seen[0] == ("1", 1)
    assert seen[1][1] == drjit.thread_count() == max(before, os.cpu_count() or 1)
    one, both = (np.load(tmp_path / f"c/streams/{name}.npy") for name in ("one", "all"))
    np.testing.assert_array_equal(one, both)
    for wrong in ("0", "-3", "100000"):
        assert qsim.cli.program.main(["sense", str(clip.path), "--ppp", "3", "--threads", wrong]) == 2
        assert f"--threads {wrong}: this machine has" in capsys.readouterr().err
    assert "QSIM_THREADS" not in os.environ
