"""Tests the training loop: resumed equals uninterrupted, NaN stops it, low precision, two processes."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from clips import write_clip, write_dataset
from golden import TINY
from runs import TINY as NETWORKS
from runs import same_weights, settings, small_network, tiny, tiny_settings
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode

from quiver import threads
from quiver.evaluation import metrics
from quiver.evaluation.macs import macs
from quiver.model.blocks import RADIUS, Output
from quiver.model.presets import build
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNetConfig
from quiver.model.weights import load, metadata_of
from quiver.training import loop as training
from quiver.training.loop import Diverged, Trainer, make_windows, train
from quiver.training.processes import Process, begin_worker
from quiver.training.run_folder import Run
from quiver.training.schedule import State, learning_rate
from quiver.training.settings import settled
from quiver.training.systems import system_of

ROOT = Path(__file__).parents[3]


class Killed(Exception):
    """Stands for a killed process: the loop cleans up nothing."""


@pytest.mark.parametrize(("schedule", "optimiser"), [("cosine", "adam"), ("plateau", "adam"), ("cosine", "muon")])
def test_killed_and_resumed_equals_uninterrupted(tiny_dataset, tmp_path, monkeypatch, schedule, optimiser):
    """Killed after step 5 with the last state saved at step 3: steps 4 and 5 are repeated bit for bit."""
    through = small_network()
    kinds = {"schedule": schedule, "optimiser": optimiser}
    whole = train(through, settings(tiny_dataset, tmp_path / "a", **kinds), progress=False)

    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    asked = []

    def kill() -> bool:
        asked.append(1)
        if len(asked) == 3:
            monkeypatch.setattr(training, "CHECKPOINT_SECONDS", math.inf)
        if len(asked) == 5:
            raise Killed
        return False

    again = settings(tiny_dataset, tmp_path / "b", **kinds)
    with pytest.raises(Killed):
        train(small_network(), again, should_stop=kill, progress=False)
    assert torch.load(tmp_path / "b/checkpoint.pt", weights_only=True)["state"]["step"] in (2, 3)
    resumed = small_network(seed=99)  # its initial weights must not matter
    state = train(resumed, again, progress=False)
    assert same_weights(through, resumed)
    assert state.step == whole.step == 6
    timeless = [{k: v for k, v in entry.items() if k != "elapsed"} for entry in state.history]
    assert timeless == [{k: v for k, v in entry.items() if k != "elapsed"} for entry in whole.history]
    assert same_weights(load(tmp_path / "a/best.safetensors"), load(tmp_path / "b/best.safetensors"))


def test_the_first_validation_saves_and_every_start_says_its_step(tiny_dataset, tmp_path):
    """Killed at step 4 after a validation at step 3, it resumes after 3; killed before, it says why it starts at 0."""

    def killed_at(step: int) -> list[str]:
        asked = []
        said = []

        def kill() -> bool:
            asked.append(1)
            if len(asked) == step:
                raise Killed
            return False

        with pytest.raises(Killed):
            train(small_network(), wanted, should_stop=kill, progress=False, note=said.append)
        return said

    wanted = settings(tiny_dataset, tmp_path / "r", validate_every=3)
    when = "saved at the first validation, then every 120 s, at the end and on Ctrl-C"
    assert killed_at(2)[-1] == f"starts at step 0 of 6; the state is {when}"
    again = killed_at(4)[-1]
    assert again == f"starts again at step 0 of 6: the earlier run ended before it saved its state; the state is {when}"
    said: list[str] = []
    assert train(small_network(), wanted, progress=False, note=said.append).step == 6
    assert said[-1] == f"resumes after step 3 of 6, the last saved state; the state is {when}"
    train(small_network(), wanted, progress=False, note=said.append)
    assert said[-1] == "the run is finished: it ended after step 6"


def test_an_interruption_saves_its_step(tiny_dataset, tmp_path):
    steps = []

    def stop() -> bool:
        steps.append(1)
        return len(steps) == 2

    state = train(small_network(), settings(tiny_dataset, tmp_path / "r"), should_stop=stop, progress=False)
    assert state.step == 2
    assert torch.load(tmp_path / "r/checkpoint.pt", weights_only=True)["state"]["step"] == 2
    assert train(small_network(), settings(tiny_dataset, tmp_path / "r"), progress=False).step == 6


@pytest.mark.parametrize("end", [{"steps": 2}, {"steps": None, "minutes": 0.005}])
def test_a_finished_run_stays_finished(tiny_dataset, tmp_path, end):
    ended = settings(tiny_dataset, tmp_path / "r", **end)
    first = train(small_network(), ended, progress=False)
    again = train(small_network(1), ended, progress=False)
    assert (again.history, again.step) == (first.history, first.step)


@pytest.mark.parametrize("lack", ["memory", "tensorboard"])
def test_a_run_is_replaced_only_by_one_that_can_start(tiny_dataset, tmp_path, monkeypatch, lack):
    once = settings(tiny_dataset, tmp_path / "r", steps=1)
    train(small_network(), once, progress=False)
    before = {path.name: path.read_bytes() for path in (tmp_path / "r").iterdir()}
    network = small_network()

    def full(device: torch.device) -> nn.Module:
        raise MemoryError

    if lack == "memory":
        monkeypatch.setattr(network, "to", full)
    else:
        monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises((MemoryError, ValueError, ModuleNotFoundError)):
        train(network, replace(once, optimiser="muon"), progress=False, force=True)
    assert "best.safetensors" in before
    assert {path.name: path.read_bytes() for path in (tmp_path / "r").iterdir()} == before


@pytest.mark.slow
def test_a_run_leaves_its_process_as_it_was(tiny_dataset, tmp_path, monkeypatch):
    """Threads of torch and denormal numbers, whether it ends or fails; on a machine of one core, too."""
    before = torch.get_num_threads()
    monkeypatch.setattr(threads, "cores", lambda: before + 1)
    train(small_network(), settings(tiny_dataset, tmp_path / "r", steps=1, threads=before + 1), progress=False)
    with pytest.raises(ValueError, match="crop"):
        train(small_network(), settings(tiny_dataset, tmp_path / "s", crop=18), progress=False)
    assert torch.get_num_threads() == before
    assert torch.tensor(5e-324, dtype=torch.float64) * 1.0 > 0


def test_workers_do_not_change_the_run(tiny_dataset, tmp_path):
    alone = small_network()
    helped = small_network()
    train(alone, settings(tiny_dataset, tmp_path / "a", steps=2), progress=False)
    train(helped, settings(tiny_dataset, tmp_path / "b", steps=2, workers=1), progress=False)
    assert same_weights(alone, helped)


def test_batches_know_their_workers(tiny_dataset, tmp_path, monkeypatch):
    """Workers leave Ctrl-C to this process, and the error of one is its own sentence."""
    asked: list[object] = []

    def loader(windows: object, **named: object) -> object:
        asked.append(named["worker_init_fn"])
        yield {}
        text = "Caught ValueError in DataLoader worker process 0.\nOriginal Traceback (most recent call last):\n  File"
        raise ValueError(f"{text}\nValueError: clip a: frame 3 is damaged\n")

    monkeypatch.setattr(training, "DataLoader", loader)
    run = settings(tiny_dataset, tmp_path / "r", workers=1)
    alone = Process(0, 1, torch.device("cpu"))
    found = training.batches(None, run, State(), alone)  # type: ignore[arg-type]
    assert next(found) == {}
    with pytest.raises(ValueError, match=r"^clip a: frame 3 is damaged$"):
        next(found)
    assert asked == [begin_worker]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_reaches_all_processes_and_the_state_is_saved(tiny_dataset, tmp_path, number):
    """A terminal sends it to the workers too, and job managers send them the other."""
    words = ["-m", "quiver", "train", str(tiny_dataset), "-o", str(tmp_path / "r"), "--preset", "unet", "--steps"]
    words += ["100000", "--crop", "16", "--batch", "1", "--validate-every", "3", "--workers", "1", "--threads", "1"]
    with subprocess.Popen(
        [sys.executable, *words, "-q"], cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        end = time.monotonic() + 120
        while not (tmp_path / "r/history.json").exists() and process.poll() is None and time.monotonic() < end:
            time.sleep(0.2)
        os.killpg(process.pid, number)
        _, said = process.communicate(timeout=120)
    assert (process.returncode, said.splitlines()) == (
        130,
        ["quiver: interrupted; the same command resumes where it stopped"],
    )
    assert torch.load(tmp_path / "r/checkpoint.pt", weights_only=True)["state"]["step"] >= 3


def test_it_learns(tiny_dataset, tmp_path):
    """Forty steps at a high rate halve the root mean squared error of the untrained network, on held-out clips."""
    quick = settings(tiny_dataset, tmp_path / "r", steps=40, learning_rate=1e-2, loss="l1")
    state = train(small_network(), quick, progress=False)
    network = small_network()
    before, _ = training.validate(network, make_windows(quick, 4)[1], torch.device("cpu"), system_of(network))
    assert state.history[-1]["psnr"] > before.psnr + 6


class Poisoned(nn.Module):
    """Returns NaN from its third call with gradients on, as a network that diverges."""

    multiple = 4
    config = UNetConfig(1)

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones(()))
        self.calls = 0

    def forward(self, x: Tensor) -> Output:
        self.calls += torch.is_grad_enabled()
        bad = math.nan if self.calls == 3 and torch.is_grad_enabled() else 1.0
        full = x[:, 5:-5] * self.factor * bad
        return Output(x * self.factor, full, full[..., ::2, ::2], full[..., ::4, ::4])


def test_nan_stops_with_step_samples_and_state(tiny_dataset, tmp_path):
    network = Poisoned()
    with pytest.raises(Diverged, match=r"step 2: loss nan.*samples \[4, 5\] \(train_\d+ frame .*failed\.pt") as error:
        train(network, settings(tiny_dataset, tmp_path / "r"), progress=False)
    assert "\n" not in str(error.value)
    saved = torch.load(tmp_path / "r/failed.pt", weights_only=True)
    assert saved["samples"] == [4, 5]
    assert len(saved["keys"]) == 2
    assert saved["state"]["step"] == 2
    assert math.isfinite(float(saved["model"]["factor"]))


@pytest.mark.parametrize(
    ("network", "optimiser", "rate"),
    [("unet", "adam", 1e-3), pytest.param("quiver", "muon", 6e-3, marks=pytest.mark.slow)],
)
def test_ten_times_the_rate_stays_finite_or_stops(tiny_dataset, tmp_path, network, optimiser, rate):
    """200 steps of a protocol's optimiser; a narrow QUIVER saves time."""
    kinds = {"optimiser": optimiser, "learning_rate": 10 * rate, "loss": "scales-l1"}
    fast = settings(tiny_dataset, tmp_path / "r", steps=200, batch=1, validate_every=100, **kinds)
    torch.manual_seed(0)
    narrow = QUIVER(TINY) if network == "quiver" else small_network()
    try:
        state = train(narrow, fast, progress=False)
    except Diverged:
        return
    assert all(math.isfinite(entry["loss"]) for entry in state.history)
    assert all(bool(weight.isfinite().all()) for weight in narrow.state_dict().values())


def test_a_time_limit_ends_the_run(tiny_dataset, tmp_path, monkeypatch):
    """A clock that advances 0.1 s each time it is read: the length of a step does not depend on the machine."""
    readings = itertools.count()
    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: 0.1 * next(readings)))
    state = train(small_network(), settings(tiny_dataset, tmp_path / "r", steps=None, minutes=0.1), progress=False)
    assert 5.5 < state.elapsed < 6.5
    assert state.history[-1]["step"] == state.step
    assert 10 <= len(state.history) <= 11  # after every tenth of the time, and at the end


def test_a_crop_must_fit_the_network(tiny_dataset, tmp_path):
    with pytest.raises(ValueError, match="crop=18: this network needs a multiple of 4"):
        train(small_network(), settings(tiny_dataset, tmp_path / "r", crop=18), progress=False)
    assert not (tmp_path / "r").exists()


def test_several_folders_train_and_validate_on_all_their_clips(tmp_path):
    one = write_dataset(tmp_path / "one", {"train": 2, "val": 1})
    two = write_dataset(tmp_path / "two", {"train": 3, "test": 1})
    train(small_network(), settings((one, two), tmp_path / "r", steps=1), progress=False)
    assert json.loads((tmp_path / "r/settings.json").read_text())["data"] == [str(one), str(two)]
    windows, fixed = make_windows(settings((one, two), tmp_path), 4)
    assert [Path(clip.path).parts[-3:-1] for clip in windows.clips].count(("one", "clips")) == 2, windows.clips
    assert len(windows.clips) == 5
    assert len(fixed.dataset.clips) == 1
    with pytest.raises(FileExistsError, match="holds a run with data"):
        train(small_network(), settings(one, tmp_path / "r", steps=1), progress=False)


def test_validation_takes_every_clip_over_the_whole_range_of_light(tiny_dataset, tmp_path):
    """Two clips at six levels: six windows hold every level once and each clip three times."""
    levels = tuple(float(n) for n in range(1, 7))
    asked = settings(tiny_dataset, tmp_path / "r", ppp=levels, validation_windows=6)
    fixed = make_windows(settled(asked)[0], 4)[1]
    places = [fixed.dataset.place(n) for n in fixed.indices]
    assert [place.light for place in places] == [0, 1, 2, 3, 4, 5]
    assert sorted(place.clip for place in places) == [0, 0, 0, 1, 1, 1]


def test_without_validation_clips_the_training_clips_serve(tmp_path):
    data = write_dataset(tmp_path / "d", {"train": 1})
    with pytest.warns(UserWarning, match="no clip in split 'val'; validating on training clips"):
        make_windows(settings(data, tmp_path), 4)


def test_clips_that_train_do_not_validate(tiny_dataset, tmp_path):
    """A clip folder is in every split: alone it serves both, with the warning; beside a data set it only trains."""
    clip = write_clip(tmp_path / "clip").path
    with pytest.warns(UserWarning, match="clip: no clip in split 'val'; validating on training clips"):
        make_windows(settings(clip, tmp_path), 4)
    windows, fixed = make_windows(settings((tiny_dataset, clip), tmp_path), 4)
    assert len(windows.clips) == 4
    assert [one.name for one in fixed.dataset.clips] == ["val_0000", "val_0001"]
    _, asked = make_windows(settings((tiny_dataset, clip), tmp_path, validation_split="train"), 4)
    assert len(asked.dataset.clips) == 4


def test_a_run_resumes_only_with_its_clips(tmp_path):
    """A clip that was made since would change every later sample; a data set without all its clips is named."""
    data = write_dataset(tmp_path / "d", {"train": 2, "val": 1})
    said = list[str]()
    record = data / "jobs/train_0001.json"
    record.rename(tmp_path / "away.json")
    once = settings(data, tmp_path / "r", steps=1)
    train(small_network(), once, progress=False, note=said.append)
    lacks = f"{data}: the data set lacks 1 of its clips; a run resumes only with the clips that it began with, so"
    assert said[1:-1] == [f"{lacks} finish `qsim generate` first"]
    (tmp_path / "away.json").rename(record)
    with pytest.raises(FileExistsError, match=r"a run on other clips or codes than .* choose another folder, or start"):
        train(small_network(), once, progress=False)
    said.clear()
    train(small_network(), once, progress=False, force=True, note=said.append)
    assert len(said) == 2
    assert said[1].startswith("starts at step 0 of 1; ")
    train(small_network(), once, progress=False)


def test_a_run_resumes_only_with_its_processes_and_precision(tiny_dataset, tmp_path, monkeypatch):
    """Of another number of processes or another device its samples or its rounding would change without a word."""
    once = settings(tiny_dataset, tmp_path / "r", steps=1)
    path = tmp_path / "r/settings.json"
    train(small_network(), once, progress=False)
    found = json.loads(path.read_text())
    assert (found["processes"], found["computes_in"], len(found["clips"])) == (1, "float32", 64)
    with monkeypatch.context() as patch:
        patch.setattr(training, "is_gpu", lambda device: True)
        with pytest.raises(FileExistsError, match="in 'float32', now it would compute in 'bfloat16'; resume it"):
            train(small_network(), once, progress=False)
        patch.setattr(training, "joined", lambda device: contextlib.nullcontext(Process(0, 2, torch.device("cpu"))))
        with pytest.raises(FileExistsError, match="whose number of processes is 1, now it is 2; resume it"):
            train(small_network(), once, progress=False)


def test_bfloat16_trains_with_float32_losses(tiny_dataset, tmp_path):
    """From the same samples and weights, the first losses differ by less than bfloat16's 2^-8 of them."""
    full = train(small_network(), settings(tiny_dataset, tmp_path / "a", steps=1), progress=False)
    low = train(small_network(), settings(tiny_dataset, tmp_path / "b", steps=1, precision="bfloat16"), progress=False)
    a = full.history[0]["loss"]
    b = low.history[0]["loss"]
    assert a != b
    assert abs(a - b) < a * 2**-8


def two_processes(folder: Path, program: str) -> None:
    """Run a program as torchrun would, as rank 0 and rank 1, to its end."""
    (folder / "run.py").write_text(program)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = os.environ | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    words = [sys.executable, str(folder / "run.py")]
    workers = [subprocess.Popen(words, cwd=ROOT, env=shared | {"RANK": str(i), "LOCAL_RANK": str(i)}) for i in (0, 1)]
    assert [process.wait(timeout=300) for process in workers] == [0, 0]


def close_weights(a: nn.Module, b: nn.Module) -> None:
    """Compare weights to the rounding of sums in another order."""
    for ours, theirs in zip(a.state_dict().values(), b.state_dict().values(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in NETWORKS if name not in ("memdeblur", "fastdvdnet")])
def test_parts_of_a_batch_add_up_to_it(tiny_dataset, tmp_path, name):
    """Losses are means over windows; MemDeblur and FastDVDnet normalise over those that they see at once."""
    found = {}
    for parts in (1, 2, 4):
        network = tiny(name)
        asked = tiny_settings(network, tiny_dataset, tmp_path / str(parts), batch=4, accumulate=parts, steps=1)
        found[parts] = network, train(network, asked, progress=False)
    for parts in (2, 4):
        close_weights(found[1][0], found[parts][0])
        losses = [found[n][1].history[-1]["loss"] for n in (1, parts)]
        assert losses[0] == pytest.approx(losses[1], rel=1e-4)


def test_parts_of_a_batch_are_equal(tiny_dataset, tmp_path):
    with pytest.raises(ValueError, match="batch=4: is no multiple of accumulate=3, and parts of a batch are equal"):
        settings(tiny_dataset, tmp_path, batch=4, accumulate=3)


def test_all_restored_frames_of_a_long_window_are_learned_from(tmp_path):
    """Of 21 frames QUIVER restores eleven in one call, and the target of each has a gradient."""
    network = QUIVER(TINY)
    called = []
    network.register_forward_hook(lambda module, given, output: called.append(output.scale1.shape[1]))
    target = torch.rand(1, 21, 1, 16, 16, requires_grad=True)
    batch = {"codes": torch.rand(1, 21, 1, 16, 16), "target": target}
    quiet = replace(settings(tmp_path, tmp_path, frames=21, loss="l1"))
    system_of(network).loss(network, batch, quiet, 0.0).backward()
    assert called == [11]
    learned = target.grad.abs().sum((0, 2, 3, 4)) > 0
    assert learned.tolist() == [RADIUS <= t < 21 - RADIUS for t in range(21)]


def test_long_windows_share_work():
    """Multiply-adds per restored pixel of `quiver-s`: 16.1 million where a window gives one frame, 3.7 where eleven."""
    with FakeTensorMode():
        network = build("quiver-s")
        each = {frames: macs(network, frames, 64, 64) / ((frames - 10) * 64**2) for frames in (11, 21, 41)}
    assert {frames: round(count / 1e6, 1) for frames, count in each.items()} == {11: 16.1, 21: 3.7, 41: 2.9}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("kind", ["kernels", "graphs"])
def test_a_compiled_network_learns_the_same(tiny_dataset, tmp_path, kind):
    plain = tiny("mergenet")
    compiled = tiny("mergenet")
    short = {"steps": 2}
    train(plain, tiny_settings(plain, tiny_dataset, tmp_path / "a", **short), progress=False)
    said = list[str]()
    asked = tiny_settings(compiled, tiny_dataset, tmp_path / "b", **short, compile=kind)
    train(compiled, asked, progress=False, note=said.append)
    assert not [line for line in said if "compile" in line]
    close_weights(plain, compiled)
    assert list(load(tmp_path / "b/last.safetensors").state_dict()) == list(plain.state_dict())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_all_stages_of_quiver_are_one_graph():
    """Of 21 frames, too: what cuts a graph would be launched piece by piece."""
    graphs = []

    def kept(graph: torch.fx.GraphModule, inputs: list[Tensor]) -> object:
        graphs.append(graph)
        return graph.forward

    torch.compile(QUIVER(TINY), backend=kept, fullgraph=True)(torch.rand(1, 21, 1, 16, 16))
    assert len(graphs) == 1


def test_what_does_not_compile_trains_without_it(tiny_dataset, tmp_path, monkeypatch):
    """With one line, and the weights of a run that never tried."""

    def broken(network: nn.Module, backend: str) -> object:
        def called(*words: object) -> object:
            torch.rand(3)
            raise RuntimeError("no compiler\nlong trace")

        return called

    monkeypatch.setattr(torch, "compile", broken)
    reasons = {
        "quiver": "torch.compile does not work here, so the network is not compiled: no compiler",
        "unet": "the loss of this network calls its parts one by one, so it is not compiled",
    }
    for name, reason in reasons.items():
        plain = tiny(name)
        tried = tiny(name)
        train(plain, settings(tiny_dataset, tmp_path / f"{name}-a", steps=2), progress=False)
        said = list[str]()
        asked = settings(tiny_dataset, tmp_path / f"{name}-b", steps=2, compile="kernels")
        train(tried, asked, progress=False, note=said.append)
        assert [line for line in said if "compile" in line] == [reason]
        assert same_weights(plain, tried)


def test_the_number_of_workers_follows_the_device(monkeypatch):
    """None beside a CPU that trains; for a GPU most cores, shared by the processes of a machine."""
    monkeypatch.setattr(training.threads, "cores", lambda: 12)
    alone = Process(0, 1, torch.device("cpu"))
    assert [training.drawing_processes(asked, alone, 16) for asked in (None, 0, 5)] == [0, 0, 5]
    monkeypatch.setattr(training, "is_gpu", lambda device: True)
    assert [training.drawing_processes(asked, alone, 16) for asked in (None, 0, 5)] == [11, 0, 5]
    assert training.drawing_processes(None, alone, 2) == 2
    assert training.drawing_processes(None, Process(1, 4, torch.device("cpu")), 16) == 2
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")  # of eight processes on four machines
    assert training.drawing_processes(None, Process(1, 8, torch.device("cpu")), 16) == 5
    monkeypatch.setattr(training.threads, "cores", lambda: 1)
    assert training.drawing_processes(None, alone, 16) == 1


def test_windows_drawn_on_a_device_train_the_same_weights(tiny_dataset, tmp_path):
    """Also resumed, by another number of workers and from the other place."""
    networks = {}
    for place in ("host", "device"):
        networks[place] = small_network()
        asked = settings(tiny_dataset, tmp_path / place, steps=4, windows=place, drift=2)
        said = list[str]()
        train(networks[place], asked, progress=False, note=said.append)
        assert bool([line for line in said if "which holds 0.000133 GB of light" in line]) == (place == "device")
    assert same_weights(networks["host"], networks["device"])
    resumed = small_network()
    stops = iter((False, True))
    once = settings(tiny_dataset, tmp_path / "r", steps=4, windows="device", drift=2)
    train(resumed, once, should_stop=lambda: next(stops), progress=False)
    assert train(resumed, replace(once, windows="host", workers=1), progress=False).step == 4
    assert same_weights(networks["host"], resumed)


def test_windows_of_a_pool_train_the_same_weights_in_both_places(tiny_dataset, tmp_path, monkeypatch):
    """Other weights than those of all clips; a resumed run has the pool that it began with."""
    for module in ("windows", "device_windows"):
        monkeypatch.setattr(f"quiver.data.{module}.STAY", 2)
    networks = {name: small_network() for name in ("host", "device", "all")}
    for name, network in networks.items():
        kind = {"windows": "host"} if name == "all" else {"windows": name, "pool": 1}
        train(network, settings(tiny_dataset, tmp_path / name, steps=4, **kind), progress=False)
    assert same_weights(networks["host"], networks["device"])
    assert not same_weights(networks["host"], networks["all"])
    with pytest.raises(FileExistsError, match="holds a run with pool 1, now it is 2"):
        train(small_network(), settings(tiny_dataset, tmp_path / "host", steps=4, pool=2), progress=False)


def test_windows_go_to_a_gpu_by_themselves(tiny_dataset, tmp_path, monkeypatch):
    """Where they fit; else one line says why the host draws them. Asked for, they have to."""
    run, _ = settled(settings(tiny_dataset, tmp_path / "r"))
    windows, _ = make_windows(run, 4)
    here = Process(0, 1, torch.device("cpu"))
    assert training.on_its_device(windows, run, here) == (None, [])
    monkeypatch.setattr(training, "is_gpu", lambda device: True)
    held, lines = training.on_its_device(windows, run, here)
    assert held is not None
    assert lines == ["windows are drawn on the device, which holds 0.000133 GB of light"]
    assert training.on_its_device(windows, replace(run, windows="host"), here) == (None, [])
    monkeypatch.setattr(training, "light_memory", lambda device: 1000)
    why = "their light is 0.000133 GB, and 1e-06 GB are for it"
    assert training.on_its_device(windows, run, here) == (None, [f"windows are drawn on the host: {why}"])
    with pytest.raises(ValueError, match=f"windows=device: no device draws these windows: {why}; leave it out"):
        training.on_its_device(windows, replace(run, windows="device"), here)


@pytest.mark.slow
@pytest.mark.parametrize(("parts", "ahead"), [(1, 0), (2, 0), (2, 2)])
def test_two_processes_train_as_one_with_twice_the_batch(tiny_dataset, tmp_path, parts, ahead):
    """torchrun with gloo averages gradients over both shares: weights agree with a batch of four to rounding.

    So they do where each process computes its share in parts, and where it reads the numbers of a step later.
    """
    alone = small_network()
    train(alone, settings(tiny_dataset, tmp_path / "a", batch=4, steps=3), progress=False)
    two_processes(
        tmp_path,
        "import torch\n"
        "from quiver.training import loop\n"
        "from quiver.training.settings import Settings\nfrom quiver.training.loop import train\n"
        "from quiver.model.unet import UNet, UNetConfig\n"
        "torch.set_num_threads(1)\ntorch.manual_seed(0)\n"
        f"loop.steps_ahead = lambda device: {ahead}\n"
        f"train(UNet(UNetConfig(4)), Settings({str(tiny_dataset)!r}, {str(tmp_path / 'b')!r}, steps=3, crop=16,"
        f" batch=2, accumulate={parts}, validate_every=4, warmup=2, validation_windows=2), progress=False)\n",
    )
    close_weights(alone, load(tmp_path / "b/last.safetensors"))


@pytest.mark.slow
def test_processes_whose_clocks_differ_stay_equal(tiny_dataset, tmp_path):
    """The clock of rank 1 runs at a tenth of the speed: with a time limit both still have one learning rate."""
    two_processes(
        tmp_path,
        "import hashlib, os, time, torch\n"
        "from pathlib import Path\nfrom types import SimpleNamespace\n"
        "from quiver.training import loop\nfrom quiver.training.settings import Settings\n"
        "from quiver.model.unet import UNet, UNetConfig\n"
        "torch.set_num_threads(1)\ntorch.manual_seed(0)\n"
        "rank = os.environ['RANK']\nspeed = (1.0, 0.1)[int(rank)]\n"
        "loop.time = SimpleNamespace(monotonic=lambda: speed * time.monotonic())\n"
        "network = UNet(UNetConfig(4))\n"
        f"loop.train(network, Settings({str(tiny_dataset)!r}, {str(tmp_path / 'r')!r}, minutes=0.05, crop=16, batch=1,"
        " warmup=2, validation_windows=1), progress=False)\n"
        "values = b''.join(value.numpy().tobytes() for value in network.state_dict().values())\n"
        f"(Path({str(tmp_path)!r}) / f'{{rank}}.txt').write_text(hashlib.sha256(values).hexdigest())\n",
    )
    assert (tmp_path / "0.txt").read_text() == (tmp_path / "1.txt").read_text()


def test_the_leader_tells_how_much_time_has_passed(tiny_dataset, tmp_path):
    class Follower(Process):
        """A process whose leader is half a minute into the run."""

        def from_leader(self, number: float) -> float:
            return 30.0

    network = small_network()
    run = settled(settings(tiny_dataset, tmp_path / "r", steps=None, minutes=1.0))[0]
    windows, fixed = make_windows(run, 4)
    trainer = Trainer(network, Run(run), fixed, Follower(1, 1, torch.device("cpu")), system_of(network))
    for n in range(2):
        trainer.step(torch.utils.data.default_collate([windows[n]]))
    assert trainer.state.elapsed == 30.0
    assert trainer.rate == learning_rate(run, State(step=1, elapsed=30.0))


def scored(psnr: float) -> metrics.Score:
    return metrics.Score(psnr, psnr, 0.5, 0.5, scale=1.0, scale_spread=0.0, frames=1)


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_windows_without_a_finite_score_do_not_count(tiny_dataset, tmp_path, monkeypatch, value):
    """Such as black ones that are restored as black; a validation of them alone has no other score."""
    found = itertools.chain((scored(value), scored(20.0)), itertools.repeat(scored(value)))
    network = small_network()
    monkeypatch.setattr(metrics, "score", lambda *images: next(found))
    windows = make_windows(settings(tiny_dataset, tmp_path / "r"), 4)[1]
    assert len(windows) == 2
    assert training.validate(network, windows, torch.device("cpu"), system_of(network))[0] == scored(20.0)
    alone = training.validate(network, windows, torch.device("cpu"), system_of(network))[0].psnr_matched
    assert str(alone) == str(value)


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_a_validation_without_a_finite_score_does_not_end_the_run(tiny_dataset, tmp_path, monkeypatch, value):
    """Of three validations the second has one: its weights are the best."""
    values = iter((value, 20.0, value))
    monkeypatch.setattr(training, "validate", lambda *words: (scored(next(values)), torch.zeros(8, 24)))
    once = settings(tiny_dataset, tmp_path / "r", steps=3, validate_every=1, schedule="plateau")
    state = train(small_network(), once, progress=False)
    assert (state.finished, state.best, state.plateau_best, state.plateau_bad) == (True, 20.0, 20.0, 0)
    stored = json.loads((tmp_path / "r/history.json").read_text())["history"]
    assert [entry["psnr_matched"] for entry in stored] == [None, 20.0, None]
    assert metadata_of(tmp_path / "r/best.safetensors")["step"] == "2"
    assert train(small_network(), once, progress=False).step == 3


def test_validation_has_one_peak_for_every_sensor(tiny_dataset, tmp_path):
    """Of 1-bit codes at 10 PPP the peak is 25 photons, not the white of 1, which every pixel of the truth exceeds."""
    asked = settings(tiny_dataset, tmp_path / "r", sensor="spad-320x240", ppp=(10.0,), bits=(1,))
    windows = make_windows(settled(asked)[0], 4)[1]
    sample = windows[0]
    assert (float(sample["white"]), float(sample["peak"])) == (1.0, pytest.approx(25.0))
    assert float(sample["target"].max()) > 8  # the ceiling of training targets does not cut the truth

    class Exact(torch.nn.Module):
        """Returns a share of the truth."""

        share = 0.8

        def forward(self, x: Tensor) -> Output:
            restored = self.share * sample["target"][RADIUS : RADIUS + 1][None]
            return Output(None, restored, None, None)

    only = torch.utils.data.Subset(windows.dataset, [windows.indices[0]])
    score, _ = training.validate(Exact(), only, torch.device("cpu"))
    truth = sample["target"][RADIUS].numpy() / 25.0
    assert score.psnr == pytest.approx(float(metrics.psnr(0.8 * truth, truth)[0]), abs=1e-3)
    assert score.psnr < 30
    assert score.above_peak < 0.05
