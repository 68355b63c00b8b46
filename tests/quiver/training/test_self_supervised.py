"""bit2bit learns from the frames of one stream: its law, its windows, resuming, and the command."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import write_clip
from runs import same_weights

from qsim.keys import Key
from qsim.sensor import devices
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.sensor.spike import SpikeCamera
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.baselines import moment
from quiver.cli.program import main
from quiver.data.codes import Codes, array_codes
from quiver.data.stream_windows import StreamWindows, stream_at
from quiver.data.windows import WindowSettings
from quiver.model.rivals.bit2bit import Bit2Bit
from quiver.model.weights import load
from quiver.training import loop as training
from quiver.training.loop import Trainer, train
from quiver.training.processes import Process
from quiver.training.run_folder import Run
from quiver.training.self_supervised import config_for, make_stream_windows
from quiver.training.settings import Settings
from quiver.training.systems import system_of


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    """A stream of seven planes per frame, in a clip folder."""
    clip = write_clip(tmp_path / "clip", frames=16, height=24, width=32)
    return sense(clip, Sensing("spad-320x240", bits=3, ppp=3.0))[0].path


def small(codes: Codes, seed: int = 0) -> Bit2Bit:
    torch.manual_seed(seed)
    return Bit2Bit(replace(config_for(codes), width=4))


def settings_of(stream: Path, out: Path, **changes: object) -> Settings:
    own = {"steps": 4, "frames": 8, "crop": 16, "batch": 2, "loss": "own", "learning_rate": 2e-3, "warmup": 1}
    return Settings(str(stream), str(out), "bit2bit", **own | changes)


def test_the_law_is_that_of_the_codes():
    codes = np.zeros((4, 8, 8), np.uint8)
    planes = array_codes(codes, BinarySPAD(0.4, 100.0, bits=3), 7e-4)
    found = config_for(planes)
    assert (found.as_published, found.planes) == (False, 7)
    assert found.dark * planes.white * 0.4 == pytest.approx(100.0 * 7e-4, rel=1e-6)  # detections per code
    counts = config_for(array_codes(codes, QIS(0.8, 1.6, 0.2, 3, gain=1.0), 5e-4))
    assert (counts.as_published, counts.planes) == (True, 7)
    with pytest.raises(ValueError, match=r"its codes are 0\.135 per electron; bit2bit needs photon counts"):
        config_for(array_codes(codes, QIS(0.8, 1.6, 0.2, 3, gain=0.135), 5e-4))


COUNTS = QIS(0.8, 1.6, 0.2, 3)


@pytest.mark.parametrize(
    ("sensor", "changes", "reason"),
    [
        (replace(COUNTS, offset=2.0), {}, "shifted by an offset of 2"),
        (replace(COUNTS, read_noise=0.6), {}, "blurred by a read noise of 0.6 electrons"),
        (SpikeCamera(0.5, 0.0, 8), {}, "spikes of collected charge"),
        (COUNTS, {"colour": ColourFilter(("RG", "GB"))}, "those of colour filters"),
        (COUNTS, {"shares": (1.0, 0.25)}, "those of different exposures"),
    ],
    ids=["offset", "read noise", "spikes", "mosaic", "bracketed"],
)
def test_codes_that_are_no_counts_are_refused(sensor, changes, reason):
    codes = replace(array_codes(np.zeros((4, 16, 16), np.uint8), sensor, 5e-4), **changes)
    message = f"^codes: its codes are {reason}; bit2bit needs photon counts of one kind: give a stream"
    with pytest.raises(ValueError, match=message):
        config_for(codes)
    with pytest.raises(ValueError, match=message):
        StreamWindows(codes, WindowSettings(frames=4, crop=16))


@pytest.mark.parametrize(
    ("sensor", "ppp", "lost"),
    [
        (QIS(1.0, 0.2, 0.21, 1), 1.0, 37),
        (QIS(0.8, 1.6, 0.2, 3), 9.75, 20),
        (CountingSPAD(0.35, 25.0, 1e-6, 8), 300.0, 17),
    ],
    ids=["one bit", "three bits", "dead time"],
)
def test_counts_that_lose_light_are_refused(sensor, ppp, lost):
    """They trained, and were restored too dark by that share; a stream that does not state its light as well."""
    photons = np.full((11, 16, 16), ppp)
    drawn = array_codes(sensor.sample(photons, 5e-4, key=Key(1, 1), engine="reference"), sensor, 5e-4)
    with pytest.raises(ValueError, match=f"^codes: its codes lose {lost} % of the events of the mean light to saturat"):
        config_for(replace(drawn, ppp=ppp))
    with pytest.raises(ValueError, match=r"its codes lose \d\d % of the events"):
        config_for(drawn)


def test_sums_of_planes_and_dim_counts_are_taken():
    """Planes that saturate have an exact law; the default sensor loses 0.3 % at 3.25 PPP."""
    codes = np.zeros((4, 8, 8), np.uint8)
    assert not config_for(replace(array_codes(codes, BinarySPAD(1.0, 0.0, 3), 5e-4), ppp=9.75)).as_published
    assert config_for(replace(array_codes(codes, devices.quiver_physical(3.25), 5e-4), ppp=3.25)).as_published


def test_the_command_refuses_a_black_level_before_it_trains(tmp_path, capsys):
    clip = write_clip(tmp_path / "clip", frames=8, height=16, width=16)
    sense(clip, Sensing(replace(COUNTS, offset=2.0), ppp=3.0))
    words = ["train", str(clip.path), "-o", str(tmp_path / "x"), "--preset", "bit2bit", "--steps", "1"]
    assert main([*words, "--crop", "16", "--frames", "8"]) == 2
    said = capsys.readouterr().err
    assert "its codes are shifted by an offset of 2; bit2bit needs photon counts" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_windows_are_parts_of_the_stream(stream):
    """Unturned ones are found in the stream where the key states; sample n repeats; turned ones hold the same codes."""
    codes = stream_at(stream)
    stack = codes.read(0, 16)
    plain = WindowSettings(frames=5, crop=12, flips=False, reverse=False)
    windows = StreamWindows(codes, plain)
    turning = StreamWindows(codes, replace(plain, flips=True, reverse=True))
    seen = set()
    for n in range(8):
        sample = windows[n]
        values = (sample["codes"].numpy()[:, 0] * 7).round().astype(np.uint8)
        start = int(sample["key"].partition("frame ")[2].partition(",")[0])
        y, x = (int(v) for v in sample["key"].partition("(y, x) (")[2].partition(")")[0].split(", "))
        np.testing.assert_array_equal(values, stack[start : start + 5, y : y + 12, x : x + 12])
        assert torch.equal(windows[n]["codes"], sample["codes"])
        torch.testing.assert_close(turning[n]["codes"].sum(), sample["codes"].sum())
        seen.add((start, y, x))
    assert len(seen) > 4
    for size in ({"frames": 17}, {"crop": 25}):
        with pytest.raises(ValueError, match="choose a smaller crop= or fewer frames="):
            StreamWindows(codes, replace(plain, **size))


def test_windows_are_sent_to_workers_without_their_codes(stream):
    """A worker opens the stream again, whose defective pixels it fills alike."""
    windows = StreamWindows(stream_at(stream), WindowSettings(frames=5, crop=12, seed=3))
    sent = pickle.dumps(windows)
    assert len(sent) < 2000
    again = pickle.loads(sent)
    assert all(torch.equal(again[n]["codes"], windows[n]["codes"]) for n in range(3))
    assert again[2]["key"] == windows[2]["key"]


@pytest.mark.slow
def test_workers_do_not_change_the_run(stream, tmp_path):
    codes = stream_at(stream)
    networks = []
    for workers in (0, 1):
        networks.append(small(codes))
        torch.manual_seed(5)
        train(networks[-1], settings_of(stream, tmp_path / str(workers), steps=2, workers=workers), progress=False)
    assert same_weights(*networks)


class Killed(Exception):
    """Stands for a killed process."""


def test_killed_and_resumed_equals_uninterrupted(stream, tmp_path, monkeypatch):
    codes = stream_at(stream)
    through = small(codes)
    torch.manual_seed(5)
    train(through, settings_of(stream, tmp_path / "a"), progress=False)
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    asked = []

    def kill() -> bool:
        asked.append(1)
        if len(asked) == 2:
            monkeypatch.setattr(training, "CHECKPOINT_SECONDS", math.inf)
        if len(asked) == 3:
            raise Killed
        return False

    begun = small(codes)
    torch.manual_seed(5)  # splits are drawn by torch's generator, whose state is stored
    with pytest.raises(Killed):
        train(begun, settings_of(stream, tmp_path / "b"), should_stop=kill, progress=False)
    resumed = small(codes, seed=9)
    state = train(resumed, settings_of(stream, tmp_path / "b"), progress=False)
    assert (state.step, state.finished, state.history) == (4, True, [])
    assert same_weights(through, resumed)
    assert same_weights(load(tmp_path / "b/best.safetensors"), resumed)


class Second(Process):
    """The second of two processes, without the first."""

    def from_leader(self, number: float) -> float:
        return number

    def any(self, condition: bool) -> bool:
        return condition


def test_of_several_processes_each_splits_by_its_samples(stream, tmp_path, monkeypatch):
    """The stored random state is the leader's: a resumed process draws what it would have drawn."""
    monkeypatch.setattr(torch.nn.parallel, "DistributedDataParallel", lambda module, **options: module)
    run = settings_of(stream, tmp_path / "r")
    codes = stream_at(stream)
    losses = []
    windows = make_stream_windows(run)
    batch = torch.utils.data.default_collate([windows[2], windows[3]])
    for seed, first in ((1, 2), (5, 2), (5, 6)):
        network = small(codes)
        trainer = Trainer(network, Run(run), None, Second(1, 2, torch.device("cpu")), system_of(network))
        torch.manual_seed(seed)
        trainer.step(batch | {"sample": torch.tensor([first, first + 1])})
        losses.append(trainer.loss)
    assert losses[0] == losses[1]
    assert losses[1] != losses[2]


@pytest.mark.slow
def test_it_learns_the_light_of_its_stream(tmp_path):
    """A scene at rest: after 150 steps nearer to the light than half of what the codes of a frame are."""
    one = write_clip(tmp_path / "one", frames=1, height=32, width=32).radiance(0)
    clip = write_clip(tmp_path / "clip", frames=16, height=32, width=32, radiance=np.repeat(one[None], 16, axis=0))
    path = sense(clip, Sensing("spad-320x240", bits=3, ppp=3.0))[0].path
    codes = stream_at(path)
    torch.manual_seed(0)
    network = Bit2Bit(replace(config_for(codes), width=8))
    train(network, settings_of(path, tmp_path / "r", steps=150, crop=32, frames=16), progress=False)
    stack = codes.read(0, 16)
    with torch.inference_mode():
        found = network.eval()(torch.from_numpy(stack / np.float32(7))[None, :, None])[0, :, 0].numpy() * codes.white
    light = one * (3.0 / one.mean())
    alone = moment.restore(stack, codes.sensor, codes.exposure, window=1)
    error, of_codes = (np.sqrt(np.mean((video[8] - light) ** 2)) for video in (found, alone))
    assert error < 0.5 * of_codes
    assert found.mean() == pytest.approx(3.0, rel=0.1)


def test_the_command_trains_on_a_clip_and_restores_it(stream, tmp_path, capsys):
    """The clip folder, or its stream; the run is a method; options of data sets are refused."""
    clip = tmp_path / "clip"
    run = tmp_path / "run"
    small_run = ["--steps", "1", "--crop", "16", "--frames", "8", "-q"]
    assert main(["train", str(clip), "-o", str(run), "--preset", "bit2bit", *small_run, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["weights"] == str(run / "best.safetensors")
    assert main(["restore", str(clip), "--method", str(run), "-o", str(tmp_path / "v.npy"), "-q"]) == 0
    assert np.load(tmp_path / "v.npy").shape == (16, 24, 32)
    capsys.readouterr()
    words = ["train", str(clip), "-o", str(tmp_path / "x"), "--preset", "bit2bit", *small_run]
    for more in (["--ppp", "3"], ["--bits", "3"], ["--validation-split", "val"], ["--validate-every", "5"]):
        assert main([*words, *more]) == 2
        assert "is for data sets, and bit2bit learns from one stream" in capsys.readouterr().err
    assert main(["train", str(tmp_path / "none.npy"), *words[2:]]) == 2
    assert "no stored stream" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
