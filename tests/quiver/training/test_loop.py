"""One loop: killed and resumed equals uninterrupted, NaN stops it, schedules, files, low precision, two processes."""

from __future__ import annotations

import errno
import json
import math
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from clips import write_dataset
from safetensors import safe_open
from torch import Tensor, nn

from qsim import files
from quiver.cli.program import main
from quiver.evaluation import metrics
from quiver.model.blocks import RADIUS, Output
from quiver.model.presets import PRESETS, assemble
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import load
from quiver.training import loop as training
from quiver.training.loop import Diverged, make_windows, train
from quiver.training.optimiser import Optimiser
from quiver.training.run_folder import Run
from quiver.training.schedule import State, learning_rate, note_plateau, time_is_up
from quiver.training.settings import PROTOCOLS, Settings, settled

ROOT = Path(__file__).parents[3]


def settings(data: Path, out: Path, **changes: object) -> Settings:
    defaults = {"steps": 6, "crop": 16, "batch": 2, "validate_every": 4, "warmup": 2, "validation_windows": 2}
    return Settings(str(data), str(out), **defaults | changes)


def small_network(seed: int = 0) -> UNet:
    torch.manual_seed(seed)
    return UNet(UNetConfig(4))


def same_weights(a: nn.Module, b: nn.Module) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


class Killed(Exception):
    """Stands for a process that dies: nothing is cleaned up by the loop."""


@pytest.mark.parametrize(("schedule", "optimiser"), [("cosine", "adam"), ("plateau", "adam"), ("cosine", "muon")])
def test_killed_and_resumed_equals_uninterrupted(tiny_dataset, tmp_path, monkeypatch, schedule, optimiser):
    """Killed after step 5 with the last state saved at step 3: steps 4 and 5 are done again, to the same bits."""
    through = small_network()
    kinds = {"schedule": schedule, "optimiser": optimiser}
    whole = train(through, settings(tiny_dataset, tmp_path / "a", **kinds), progress=False)

    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    asked = []

    def die() -> bool:
        asked.append(1)
        if len(asked) == 3:
            monkeypatch.setattr(training, "CHECKPOINT_SECONDS", math.inf)
        if len(asked) == 5:
            raise Killed
        return False

    again = settings(tiny_dataset, tmp_path / "b", **kinds)
    with pytest.raises(Killed):
        train(small_network(), again, should_stop=die, progress=False)
    assert torch.load(tmp_path / "b/checkpoint.pt", weights_only=True)["state"]["step"] in (2, 3)
    resumed = small_network(seed=99)  # its own weights must not matter
    state = train(resumed, again, progress=False)
    assert same_weights(through, resumed)
    assert state.step == whole.step == 6
    timeless = [{k: v for k, v in entry.items() if k != "elapsed"} for entry in state.history]
    assert timeless == [{k: v for k, v in entry.items() if k != "elapsed"} for entry in whole.history]
    assert same_weights(load(tmp_path / "a/best.safetensors"), load(tmp_path / "b/best.safetensors"))


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


@pytest.mark.slow
def test_workers_do_not_change_the_run(tiny_dataset, tmp_path):
    alone, helped = small_network(), small_network()
    train(alone, settings(tiny_dataset, tmp_path / "a", steps=2), progress=False)
    train(helped, settings(tiny_dataset, tmp_path / "b", steps=2, workers=1), progress=False)
    assert same_weights(alone, helped)


def test_it_learns(tiny_dataset, tmp_path):
    """Forty steps at a high rate halve the root mean squared error of the untrained network, on held-out clips."""
    quick = settings(tiny_dataset, tmp_path / "r", steps=40, learning_rate=1e-2, loss="l1")
    state = train(small_network(), quick, progress=False)
    before, _ = training.validate(small_network(), make_windows(quick, 4)[1], torch.device("cpu"))
    assert state.history[-1]["psnr"] > before.psnr + 6


def test_files_of_a_run(tiny_dataset, tmp_path):
    train(small_network(), settings(tiny_dataset, tmp_path / "r"), progress=False)
    names = {path.name for path in (tmp_path / "r").iterdir()}
    assert {"settings.json", "checkpoint.pt", "best.safetensors", "last.safetensors", "history.json"} <= names
    assert any(name.startswith("events.out.tfevents") for name in names)
    with safe_open(tmp_path / "r/best.safetensors", framework="pt") as file:
        assert json.loads(file.metadata()["settings"])["ppp"] == [3.25]
    history = json.loads((tmp_path / "r/history.json").read_text())["history"]
    assert [entry["step"] for entry in history] == [4, 6]


class Poisoned(nn.Module):
    """Turns to NaN at its third call with gradients, as a network does whose weights have left the road."""

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
    with pytest.raises(Diverged, match=r"step 2: loss nan.*samples \[4, 5\] \(train_\d frame .*failed\.pt") as error:
        train(network, settings(tiny_dataset, tmp_path / "r"), progress=False)
    assert "\n" not in str(error.value)
    saved = torch.load(tmp_path / "r/failed.pt", weights_only=True)
    assert saved["samples"] == [4, 5]
    assert len(saved["keys"]) == 2
    assert saved["state"]["step"] == 2
    assert math.isfinite(float(saved["model"]["factor"]))


@pytest.mark.parametrize(("network", "optimiser", "rate"), [("unet", "adam", 1e-3), ("nano", "muon", 6e-3)])
def test_ten_times_the_rate_stays_finite_or_stops(tiny_dataset, tmp_path, network, optimiser, rate):
    """200 steps of a protocol's optimiser; of nano a narrow one, for time."""
    kinds = {"optimiser": optimiser, "learning_rate": 10 * rate, "loss": "scales-l1", "head_start": 0.85}
    fast = settings(tiny_dataset, tmp_path / "r", steps=200, batch=1, validate_every=100, **kinds)
    torch.manual_seed(0)
    narrow = (
        assemble(replace(PRESETS["nano"], estimate_width=4, attention_width=16))
        if network == "nano"
        else small_network()
    )
    try:
        state = train(narrow, fast, progress=False)
    except Diverged:
        return
    assert all(math.isfinite(entry["loss"]) for entry in state.history)
    assert all(bool(weight.isfinite().all()) for weight in narrow.state_dict().values())


def test_other_settings_are_refused(tiny_dataset, tmp_path):
    opened(settings(tiny_dataset, tmp_path / "r"))
    opened(settings(tiny_dataset, tmp_path / "r", workers=3))  # decides nothing
    with pytest.raises(FileExistsError, match="holds a run with seed 0, now it is 1"):
        opened(settings(tiny_dataset, tmp_path / "r", seed=1))
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").write_text("mine")
    for force in (False, True):
        with pytest.raises(FileExistsError, match=r"is no training run|removes only what this command made"):
            opened(settings(tiny_dataset, tmp_path / "other"), force=force)
    assert (tmp_path / "other/file").read_text() == "mine"


def opened(wanted: Settings, *, force: bool = False) -> None:
    with Run(wanted).open(force=force):
        pass


def test_one_process_at_a_time_trains_in_a_folder(tiny_dataset, tmp_path):
    """A second command, with --force or without, is refused in one line; the folder stays as it is, and free after."""
    mine = settings(tiny_dataset, tmp_path / "r")
    words = [sys.executable, "-m", "quiver", "train", tiny_dataset, "-o", mine.out, "--steps", 6, "--crop", 16]
    words += ["--preset", "unet"]
    with Run(mine).open():
        before = {path.name: path.read_bytes() for path in Path(mine.out).iterdir()}
        done = subprocess.run([str(w) for w in words], cwd=ROOT, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (2, "")
        assert f"{mine.out}: another process trains here; wait for it to end" in done.stderr
        assert done.stderr.count("\n") == 1
        assert main([str(w) for w in [*words[3:], "--force"]]) == 2
        assert {path.name: path.read_bytes() for path in Path(mine.out).iterdir()} == before
    opened(mine)


def test_a_full_disk_inside_a_checkpoint(tiny_dataset, tmp_path, monkeypatch):
    """The system's error with the file's name, and nothing half-written: every file of the folder is whole."""
    mine = settings(tiny_dataset, tmp_path / "r", steps=2)
    train(small_network(), mine, progress=False)
    whole = (tmp_path / "r/checkpoint.pt").read_bytes()

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "fsync", full)
    network = small_network()
    with pytest.raises(OSError, match="No space left") as error:
        Run(mine).save(tmp_path / "r/checkpoint.pt", network, Optimiser(network, "adam", 1e-3, (0.9, 0.99)), State())
    assert error.value.filename == str(tmp_path / "r/checkpoint.pt")
    assert (tmp_path / "r/checkpoint.pt").read_bytes() == whole
    assert not list((tmp_path / "r").glob("*.tmp-*"))


FILLED = """
import resource, signal, sys
from pathlib import Path
from quiver.training.optimiser import Optimiser
from quiver.training.run_folder import Run
from quiver.training.schedule import State
from quiver.training.settings import Settings
from quiver.model.unet import UNet, UNetConfig

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
run, network = Run(Settings("d", sys.argv[1], steps=2)), UNet(UNetConfig(4))
optimiser = Optimiser(network, "adam", 1e-3, (0.9, 0.99))
run.save(run.checkpoint, network, optimiser, State())
whole = run.checkpoint.read_bytes()
for share in (0.9, 0.5, 0.1, 0.0):
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * len(whole)), -1))
    try:
        run.save(run.checkpoint, network, optimiser, State(step=1))
    except OSError as error:
        print(error.filename, run.checkpoint.read_bytes() == whole, len(list(run.folder.iterdir())))
"""


def test_a_disk_that_is_full_after_some_bytes_of_a_checkpoint(tmp_path):
    """The write itself fails halfway, at the system's limit on a file's size: its error, and the old file stays."""
    words = [sys.executable, "-c", FILLED, str(tmp_path)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == 4 * [f"{tmp_path / 'checkpoint.pt'} True 1"]


def test_a_damaged_state_is_named(tiny_dataset, tmp_path):
    small = settings(tiny_dataset, tmp_path / "r", steps=2)
    train(small_network(), small, progress=False)
    (tmp_path / "r/checkpoint.pt").write_bytes(b"PK\x03\x04 half a file")
    with pytest.raises(ValueError, match=r"checkpoint\.pt: not a state of this run"):
        train(small_network(), small, progress=False)


def test_cosine_follows_steps_or_time():
    by_steps = Settings("d", "o", steps=1000, learning_rate=1.0, warmup=10)
    assert learning_rate(by_steps, State(step=0)) == pytest.approx(0.1)
    short = Settings("d", "o", steps=100, learning_rate=1.0, warmup=1000, schedule="plateau")
    assert learning_rate(short, State(step=2)) == pytest.approx(0.4)  # the rise ends after a twentieth: at step 5
    assert learning_rate(short, State(step=5)) == 1.0
    assert learning_rate(by_steps, State(step=500)) == pytest.approx(0.5)
    assert learning_rate(by_steps, State(step=1000)) == pytest.approx(0.01)  # never quite zero
    by_time = Settings("d", "o", minutes=10, learning_rate=1.0, warmup=0)
    assert learning_rate(by_time, State(step=77, elapsed=300)) == pytest.approx(0.5)


def test_plateau_halves_at_the_ninth_validation_without_gain():
    """Patience 8: eight validations without a relative gain of 1e-4 are borne, the ninth halves the rate."""
    state, plan = State(), Settings("d", "o", steps=9, schedule="plateau", warmup=0, learning_rate=1.0)
    note_plateau(8, state, 30.0)
    for _ in range(8):
        note_plateau(8, state, 30.002)
    assert state.halvings == 0
    note_plateau(8, state, 30.002)
    assert state.halvings == 1
    assert learning_rate(plan, state) == 0.5
    note_plateau(8, state, 30.004)
    assert state.plateau_bad == 0


def test_a_time_limit_ends_the_run(tiny_dataset, tmp_path):
    state = train(small_network(), settings(tiny_dataset, tmp_path / "r", steps=None, minutes=0.1), progress=False)
    assert state.elapsed < 30
    assert state.history[-1]["step"] == state.step
    assert 2 <= len(state.history) <= 12  # after every tenth of the time that a step ended in, and at the end


def test_the_last_validation_fits_into_the_limit():
    plan = Settings("d", "o", minutes=1)
    assert not time_is_up(plan, State(elapsed=50.0), 5.0)
    assert time_is_up(plan, State(elapsed=50.0), 11.0)
    assert not time_is_up(Settings("d", "o", steps=1), State(elapsed=1e9), 1.0)


def test_protocols_are_those_of_the_paper_and_its_program():
    published = Settings("d", "o", **PROTOCOLS["published"])
    assert (published.learning_rate, published.batch, published.crop, published.patience) == (1e-4, 8, 128, 8)
    assert (published.schedule, published.validate_every, published.clip_norm) == ("plateau", 300, 20)
    assert published.force_exposure
    assert not published.reverse
    paper = Settings("d", "o", **PROTOCOLS["paper"])
    assert (paper.learning_rate, paper.batch, paper.loss, paper.sensor) == (2.5e-5, 4, "paper", "quiver-paper")
    assert Settings("d", "o", steps=1, **PROTOCOLS["spad-sum"]).lights[0].device(7e-4).white(7e-4) == 7


def test_every_level_and_depth_is_mixed():
    lights = Settings("d", "o", steps=1, ppp=(3.25, 26.0), bits=(1, 3)).lights
    assert {(light.ppp, light.bits) for light in lights} == {(3.25, 1), (3.25, 3), (26.0, 1), (26.0, 3)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": None}, "give --steps or --minutes"),
        ({"steps": 0}, "--steps must be above 0"),
        ({"learning_rate": math.nan}, "--learning-rate must be above 0, got nan"),
        ({"loss": "l3"}, "no loss is called 'l3'; known are published, paper, l1"),
    ],
)
def test_bad_settings_are_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        settings(tmp_path, tmp_path, **changes)


def test_a_crop_must_fit_the_network(tiny_dataset, tmp_path):
    with pytest.raises(ValueError, match="--crop 18: this network needs a multiple of 4"):
        train(small_network(), settings(tiny_dataset, tmp_path / "r", crop=18), progress=False)
    assert not (tmp_path / "r").exists()


def test_without_validation_clips_the_training_clips_serve(tmp_path):
    data = write_dataset(tmp_path / "d", {"train": 1})
    with pytest.warns(UserWarning, match="no clip in split 'val'; validating on training clips"):
        make_windows(settings(data, tmp_path), 4)


def test_bfloat16_trains_with_float32_losses(tiny_dataset, tmp_path):
    """Same samples, same start: the first losses differ by less than bfloat16's 2^-8 of them."""
    full = train(small_network(), settings(tiny_dataset, tmp_path / "a", steps=1), progress=False)
    low = train(small_network(), settings(tiny_dataset, tmp_path / "b", steps=1, precision="bfloat16"), progress=False)
    a, b = full.history[0]["loss"], low.history[0]["loss"]
    assert a != b
    assert abs(a - b) < a * 2**-8


@pytest.mark.slow
def test_two_processes_train_as_one_with_twice_the_batch(tiny_dataset, tmp_path):
    """torchrun, gloo: gradients are averaged over both shares, so weights agree with a batch of four to rounding."""
    alone = small_network()
    train(alone, settings(tiny_dataset, tmp_path / "a", batch=4, steps=3), progress=False)
    program = tmp_path / "run.py"
    program.write_text(
        "import torch\n"
        "from quiver.training.settings import Settings\nfrom quiver.training.loop import train\n"
        "from quiver.model.unet import UNet, UNetConfig\n"
        "torch.set_num_threads(1)\ntorch.manual_seed(0)\n"
        f"train(UNet(UNetConfig(4)), Settings({str(tiny_dataset)!r}, {str(tmp_path / 'b')!r}, steps=3, crop=16,"
        " batch=2, validate_every=4, warmup=2, validation_windows=2), progress=False)\n"
    )
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = os.environ | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    crew = [
        subprocess.Popen([sys.executable, str(program)], cwd=ROOT, env=shared | {"RANK": str(i), "LOCAL_RANK": str(i)})
        for i in (0, 1)
    ]
    assert [process.wait(timeout=300) for process in crew] == [0, 0]
    together = load(tmp_path / "b/last.safetensors")
    for ours, theirs in zip(alone.state_dict().values(), together.state_dict().values(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_head_start_trains_the_estimate_alone(tiny_dataset, tmp_path):
    """After the first half only the estimate has moved; the second half moves the rest, from its last layers on."""

    def moved(steps: int, out: str) -> set[str]:
        torch.manual_seed(0)
        network = assemble(replace(PRESETS["nano"], estimate_width=4, attention_width=16))
        before = {name: p.detach().clone() for name, p in network.named_parameters()}
        state = State()

        def half() -> bool:
            state.step += 1
            return state.step == steps

        run = settings(tiny_dataset, tmp_path / out, steps=4, head_start=0.5, loss="scales-l1")
        train(network, run, should_stop=half, progress=False)
        return {name.split(".")[0] for name, p in network.named_parameters() if not torch.equal(p, before[name])}

    assert moved(2, "half") == {"estimate"}
    assert moved(4, "more") >= {"denoiser", "estimate", "flow", "cell", "attention", "refine"}
    plain = train(small_network(), settings(tiny_dataset, tmp_path / "unet", head_start=0.5), progress=False)
    assert plain.finished, "a network without an initial estimate is trained as always"


def test_validation_has_one_peak_for_every_sensor(tiny_dataset, tmp_path):
    """A 1-bit code at 10 PPP: the peak is 25 photons, not the white of 1 that every pixel of the truth passes."""
    asked = settings(tiny_dataset, tmp_path / "r", sensor="spad-320x240", ppp=(10.0,), bits=(1,))
    windows = make_windows(settled(asked)[0], 4)[1]
    sample = windows[0]
    assert (float(sample["white"]), float(sample["peak"])) == (1.0, pytest.approx(25.0))
    assert float(sample["target"].max()) > 8  # the ceiling of training targets does not cut the truth

    class Exact(torch.nn.Module):
        """Answers with so much of the truth."""

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
