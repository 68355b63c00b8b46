"""Every system that the loop trains: resumed equals uninterrupted, it learns, its protocols are the published ones."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import write_clip, write_dataset
from golden import SMALL
from random_codes import random_codes
from runs import TINY, same_weights, settings, tiny, tiny_settings
from torch import Tensor

from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.data.clips import open_clips
from quiver.data.codes import Codes
from quiver.data.noise_table import noise_table
from quiver.data.windows import Windows, WindowSettings
from quiver.model.names import NETWORKS, QUIVERS
from quiver.model.presets import NETWORKS as KINDS
from quiver.model.presets import build
from quiver.model.quiver import QUIVER
from quiver.model.rivals.flornn import FloRNN, FloRNNConfig, Flows
from quiver.model.rivals.memdeblur import MemDeblur, MemDeblurConfig
from quiver.model.rivals.rvrt import RVRT, RVRTConfig
from quiver.model.rivals.student_teacher import StudentTeacher, StudentTeacherConfig
from quiver.model.weights import load
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import wrap_network
from quiver.training import loop as training
from quiver.training.loop import train
from quiver.training.rival_losses import centre_frame
from quiver.training.settings import Settings, settled
from quiver.training.system import System, protocol
from quiver.training.systems import OURS, SYSTEMS, system_named, system_of

SLOW = ("rvrt", "flornn", "memdeblur", "spk2imgnet")  # more than a few seconds


def slow_ones(names: object, *more: str) -> list[object]:
    """Parameters of which the slow networks, and `more`, are left out by `make test`."""
    slow = (*SLOW, *more)
    return [pytest.param(name, marks=pytest.mark.slow) if name in slow else name for name in names]  # type: ignore[attr-defined]


class Killed(Exception):
    """Stands for a killed process."""


@pytest.mark.parametrize("name", slow_ones(TINY))
def test_killed_and_resumed_equals_uninterrupted(tiny_dataset, tmp_path, monkeypatch, name):
    """Killed after step 3 of 4 with the last state saved at step 2: bit for bit the same weights and validations."""
    through = tiny(name)
    short = {"steps": 4, "validate_every": 2, "validation_windows": 1, "crop": 16, "batch": 1}
    whole = train(through, tiny_settings(through, tiny_dataset, tmp_path / "a", **short), progress=False)

    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    asked = []

    def kill() -> bool:
        asked.append(1)
        if len(asked) == 2:
            monkeypatch.setattr(training, "CHECKPOINT_SECONDS", math.inf)
        if len(asked) == 3:
            raise Killed
        return False

    again = tiny_settings(through, tiny_dataset, tmp_path / "b", **short)
    with pytest.raises(Killed):
        train(tiny(name), again, should_stop=kill, progress=False)
    resumed = tiny(name, seed=99)  # its initial weights must not matter
    state = train(resumed, again, progress=False)
    assert same_weights(through, resumed)
    assert state.step == whole.step == 4
    assert [e["psnr"] for e in state.history] == [e["psnr"] for e in whole.history]
    stored = load(tmp_path / "b/last.safetensors")
    assert type(stored) is type(through)
    assert same_weights(stored, through)


def quick(system: System) -> dict[str, object]:
    """Optimiser, rate, clipping and loss of a system's quick protocol."""
    own = ("optimiser", "learning_rate", "clip_norm", "loss")
    return {key: value for key, value in protocol(system, "quick").items() if key in own}


LEARNING = {name: make for name, make in TINY.items() if name not in ("memdeblur", "mergenet", "rvrt")} | {
    "rvrt": lambda: RVRT(RVRTConfig(width=72, flow_levels=4)),  # six channels cannot hold the noise of each pixel
    "student-teacher": lambda: StudentTeacher(StudentTeacherConfig(width=16, blocks=1, distil=False)),
    "quiver": lambda: QUIVER(SMALL),
}


def losses(
    network: torch.nn.Module, folder: Path, shares: tuple[float, ...] = (1.0,)
) -> tuple[list[float], list[float]]:
    """Losses before and after 200 steps of the quick protocol on one clip, with new noise in each step.

    `shares` are those of the run that are over, at which a loss is computed.
    """
    data = write_dataset(folder / "d", {"train": 1, "val": 1}, height=64, width=64)
    system = system_of(network)
    short = {"steps": 200, "warmup": 10, "validate_every": 200}  # the rise that a run of 200 steps has by default
    sizes = {"crop": 64, "batch": 1, "flips": False, "reverse": False}
    run = tiny_settings(network, data, folder / "r", **quick(system) | short | sizes)
    first, _ = training.make_windows(settled(run)[0], 16, system, run.frames)
    batch = torch.utils.data.default_collate([first[i] for i in range(4)])

    def computed() -> list[float]:
        with torch.no_grad():
            return [float(system.loss(network.train(), batch, run, share)) for share in shares]

    before = computed()
    train(network, run, progress=False)
    return before, computed()


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNING)
def test_two_hundred_steps_halve_the_loss(tmp_path, name):
    """On a clip of 64 x 64 px, as section 20 of the list of acceptance tests requires.

    The student learns alone; its teachers follow below. MergeNet begins at the merged frames, whose error is small:
    test_merge_training.py. MemDeblur does not halve its loss: docs/log.md.
    """
    torch.manual_seed(0)
    (before,), (after,) = losses(LEARNING[name](), tmp_path)
    print(f"loss {before:.5g} -> {after:.5g}")
    assert after < before / 2


@pytest.mark.slow
def test_both_teachers_halve_their_losses_in_sixty_steps_each(tmp_path):
    """The student learns in the last 80 steps, while the rate falls to zero, and gets nearer to both and to the truth.

    Its loss is mostly the distances of its features from those of the teachers.
    """
    torch.manual_seed(0)
    network = StudentTeacher(StudentTeacherConfig(width=16, blocks=1))
    before, after = losses(network, tmp_path, shares=(0.0, 0.45, 1.0))
    assert after[0] < before[0] / 2
    assert after[1] < before[1] / 2
    assert after[2] < 0.9 * before[2]


@pytest.mark.parametrize("name", slow_ones(TINY, "quiver", "emvd", "fastdvdnet", "mergenet"))
def test_ten_times_the_rate_stays_finite_or_stops(tiny_dataset, tmp_path, name):
    """20 steps of its quick protocol; the U-Net and QUIVER for longer in test_loop.py."""
    network = tiny(name)
    own = quick(system_of(network))
    short = {"steps": 20, "validate_every": 20, "validation_windows": 1, "crop": 32, "warmup": 1}
    fast = own | short | {"learning_rate": 10 * own["learning_rate"]}
    try:
        state = train(network, tiny_settings(network, tiny_dataset, tmp_path, **fast), progress=False)
    except training.Diverged:
        return
    assert math.isfinite(state.history[-1]["loss"])
    assert all(bool(weight.isfinite().all()) for weight in network.state_dict().values())


@pytest.mark.parametrize("name", slow_ones(TINY))
def test_bfloat16_trains_with_float32_losses_and_weights(tiny_dataset, tmp_path, name):
    """One step, of MergeNet three: it changes nothing before its first, and little after it."""
    steps = 3 if name == "mergenet" else 1
    losses = []
    for precision in ("float32", "bfloat16"):
        network = tiny(name)
        short = {"steps": steps, "validation_windows": 1, "crop": 32, "precision": precision}
        state = train(network, tiny_settings(network, tiny_dataset, tmp_path / precision, **short), progress=False)
        losses.append(state.history[-1]["loss"])
        assert all(w.dtype == torch.float32 and bool(w.isfinite().all()) for w in network.parameters())
    assert losses[0] != losses[1]
    assert losses[1] == pytest.approx(losses[0], rel=0.1)


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", slow_ones(TINY))
def test_after_a_few_steps_a_frame_depends_on_exactly_the_declared_ones(tiny_dataset, tmp_path, name, every):
    """Frame by frame is inverted, of a clip that a network takes in one part: a frame in its middle is restored.

    Quickly the outermost frames that it declares, those beyond them, and itself.
    """
    network = tiny(name)
    short = {"steps": 4, "validate_every": 4, "validation_windows": 1, "crop": 16, "batch": 1, "warmup": 1}
    train(network, tiny_settings(network, tiny_dataset, tmp_path, **short), progress=False)
    method = wrap_network(network, name, "", RestoreOptions())
    frames, t = (8, 4) if getattr(network, "look_ahead", 0) is None else (14, 6)
    codes = random_codes(frames, 16, 20)
    before = method.restore(codes, t, t + 1)
    stack = codes.read(0, frames)
    past = method.window - 1 - method.look_ahead
    outermost = {t - past - 1, t - past, t, t + method.look_ahead, t + method.look_ahead + 1}
    for changed in range(frames) if every else sorted(outermost & set(range(frames))):
        other = stack.copy()
        other[changed] = 7 - other[changed]
        after = method.restore(replace(codes, read=lambda a, b, other=other: other[a:b]), t, t + 1)
        assert (not np.array_equal(after, before)) == (t - past <= changed <= t + method.look_ahead), changed


def test_after_a_few_steps_a_stream_depends_on_each_of_its_frames(tmp_path):
    """bit2bit is trained on the stream that it restores."""
    clip = write_clip(tmp_path / "clip", frames=16, height=24, width=32)
    stream = sense(clip, Sensing("spad-320x240", bits=3, ppp=3.0))[0].path
    network = tiny("bit2bit")
    sizes = {"frames": 8, "crop": 16, "batch": 1, "loss": "own", "warmup": 1}
    train(network, Settings(str(stream), str(tmp_path / "r"), "bit2bit", steps=4, **sizes), progress=False)
    codes = random_codes(8, 16, 20)
    method = wrap_network(network, "bit2bit", "", RestoreOptions())
    before = method.restore(codes, 4, 5)
    stack = codes.read(0, 8)
    for changed in range(8):
        other = stack.copy()
        other[changed] = 7 - other[changed]
        assert not np.array_equal(method.restore(replace(codes, read=lambda a, b, o=other: o[a:b]), 4, 5), before)


@pytest.mark.parametrize("name", slow_ones(TINY))
def test_every_weight_that_is_trained_gets_a_finite_gradient(tiny_dataset, tmp_path, name):
    """All but layers behind a zero start, whose gradients are zeros at the first step."""
    network = tiny(name).train()
    run = settled(tiny_settings(network, tiny_dataset, tmp_path, crop=32))[0]
    system = system_of(network)
    windows, _ = training.make_windows(run, system.side(network), system, system.window(network))
    batch = torch.utils.data.default_collate([windows[0], windows[1]])
    for share in (0.0, 0.45, 1.0) if name == "student-teacher" else (1.0,):  # teachers learn first
        system.loss(network, batch, run, share).backward()
    without = {n for n, p in network.named_parameters() if p.grad is None or not bool(p.grad.isfinite().all())}
    assert without == set()


# ---- Losses


def test_the_losses_of_perfect_networks_are_their_least(tiny_dataset, tmp_path):
    """Of the frames themselves as target: L1 and squares give what the network differs by, and more for another."""
    for name in ("emvd", "flornn", "spk2imgnet"):
        network = tiny(name).eval()
        codes = torch.rand(2, 12, 1, 32, 32)
        system = system_of(network)
        run = tiny_settings(network, tiny_dataset, tmp_path)
        with torch.no_grad():
            restored, first = system.restored(network, {"codes": codes})
            assert restored.shape[2:] == codes.shape[2:]
            target = codes.clone()
            far = float(system.loss(network, {"codes": codes, "target": target}, run, 1.0))
            target[:, first : first + restored.shape[1]] = restored
            near = float(system.loss(network, {"codes": codes, "target": target}, run, 1.0))
        assert near < far, name


def test_emvd_as_published_multiplies_without_transposing():
    network = tiny("emvd")
    with torch.no_grad():
        network.ft.net1["weight"][0, 0, 0, 1] += 0.5  # type: ignore[index]
    codes = torch.zeros(1, 1, 1, 16, 16)
    batch = {"codes": codes, "target": network(codes).detach()}
    run = Settings("d", "o", steps=1)
    with torch.no_grad():
        ours = float(system_of(network).loss(network, batch, run, 1.0))
        network.config = replace(network.config, as_published=True)
        theirs = float(system_of(network).loss(network, batch, run, 1.0))
    low, high = torch.tensor([[1.0, 1.0], [1.0, -1.0]]) / 2**0.5
    analysis = torch.stack([low + torch.tensor([0.0, 0.5]), high])
    synthesis = torch.stack([low, high])
    one = torch.eye(2)
    expected = [float((m - one).square().sum()) for m in (analysis.T @ synthesis, analysis @ synthesis)]
    assert ours - theirs == pytest.approx(expected[0] - expected[1], abs=1e-5)


def test_memdeblur_centres_its_targets():
    """A network whose images come back: the loss is eps at each of the three scales."""
    network = tiny("memdeblur")
    codes = torch.full((1, 2, 1, 32, 32), 0.3)
    network.scales = lambda images: [images[..., ::k, ::k] for k in (4, 2, 1)]  # type: ignore[assignment,method-assign]
    found = system_of(network).loss(network, {"codes": codes, "target": codes}, Settings("d", "o", steps=1), 1.0)
    assert float(found) == pytest.approx(3e-3, rel=1e-4)


@pytest.mark.parametrize("name", ["emvd", "flornn", "fastdvdnet"])
def test_windows_bring_the_noise_of_their_sensor(tiny_dataset, tmp_path, name):
    """Windows of two bit depths in one batch: each has its own table, and the loss and the scored frame follow it."""
    network = tiny(name)
    run = settled(tiny_settings(network, tiny_dataset, tmp_path / "r", crop=32, bits=(1, 5), ppp=(3.25,)))[0]
    system = system_of(network)
    windows, _ = training.make_windows(run, 8, system, system.window(network))
    lights = [windows.place(n).light for n in range(20)]
    batch = torch.utils.data.default_collate([windows[lights.index(0)], windows[lights.index(1)]])
    clip = windows.clips[0]
    tables = [noise_table(noise.draw(clip).sensor, clip.exposure) for noise in windows.noise.noises]
    assert np.array_equal(batch["variance"], tables)
    other = batch | {"variance": batch["variance"].flip(0)}
    with torch.no_grad():
        assert float(system.loss(network, batch, run, 1.0)) != float(system.loss(network, other, run, 1.0))
        assert not torch.equal(system.restored(network, batch)[0], system.restored(network, other)[0])


def test_the_rate_is_kept_until_the_student_learns(tiny_dataset, tmp_path):
    """Three of five steps are the teachers', and their validations, all of the same student, halve nothing."""
    network = tiny("student-teacher")
    plateau = {"schedule": "plateau", "patience": 0, "warmup": 0, "steps": 5, "validate_every": 1}
    run = tiny_settings(network, tiny_dataset, tmp_path / "r", **plateau, batch=1, validation_windows=1)
    rates = [entry["learning_rate"] for entry in train(network, run, progress=False).history]
    assert rates[:4] == [run.learning_rate] * 4
    begins = system_of(network).begins
    alone = StudentTeacher(StudentTeacherConfig(width=4, blocks=1, distil=False))
    assert (begins(network, None), begins(alone, None)) == (0.6, 0.0)
    assert system_of(tiny("unet")).begins(tiny("unet"), None) == 0.0


def test_parts_of_quiver_learn_alone_first(tiny_dataset, tmp_path):
    """For a share of the run only the pre-denoiser and the flow change; no validation before counts for a plateau."""
    network = tiny("quiver")
    before = {name: value.clone() for name, value in network.state_dict().items()}
    run = tiny_settings(network, tiny_dataset, tmp_path / "r", steps=4, pretraining=0.5, validate_every=1)
    stopped = iter((False, True))
    train(network, run, progress=False, should_stop=lambda: next(stopped))
    changed = {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}
    assert changed
    assert {name.split(".")[0] for name in changed} == {"denoiser", "flow"}
    train(network, run, progress=False)
    after = {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}
    assert {name.split(".")[0] for name in after} > {"denoiser", "flow", "cell", "attention"}
    assert system_of(network).begins(network, run) == 0.5


def test_what_has_no_such_parts_refuses_their_settings(tiny_dataset, tmp_path):
    bare = QUIVER(replace(tiny("quiver").config, pre_denoiser=False, flow=False))
    cases = {
        "has no parts that learn alone": (tiny("unet"), {"pretraining": 0.5}),
        "has neither pre-denoiser nor flow": (bare, {"pretraining": 0.5}),
        "is one of the flow": (bare, {"loss": "aligned"}),
        "unet is trained with": (tiny("unet"), {"loss": "aligned"}),
    }
    for words, (network, asked) in cases.items():
        run = tiny_settings(network, tiny_dataset, tmp_path / "r", **asked)
        with pytest.raises(ValueError, match=words):
            train(network, run, progress=False)
    assert not (tmp_path / "r").exists()


# ---- Settings


def test_the_published_protocols_are_those_of_the_ports():
    """Crop, batch, rate, frames, clip and steps: baselines as their published programs train them."""
    same = {"crop": 128, "batch": 4, "learning_rate": 1e-4, "frames": 11, "clip_norm": 20, "steps": 63_000}
    wanted = {
        "emvd": same | {"clip_norm": 5},
        "flornn": same,
        "memdeblur": same,
        "rvrt": same | {"crop": 240, "batch": 2, "frames": 12, "steps": 125_000},
        "spk2imgnet": same | {"frames": 10},
    }
    for name, values in wanted.items():
        found = Settings("d", "o", network=name, **protocol(system_named(name), "published"))
        assert {key: getattr(found, key) for key in values} == values, name
        assert (found.schedule, found.betas, found.force_exposure, found.reverse) == (
            "plateau",
            (0.9, 0.99),
            True,
            False,
        )
        assert (found.sensor, found.loss, found.patience, found.validate_every) == ("quiver-published", "own", 8, 300)


def test_every_preset_has_a_system_and_a_quick_protocol():
    known = {field.name for field in fields(Settings)}
    for name in NETWORKS:
        system = system_named(name)
        assert set(protocol(system, "quick")) <= known
        assert (system is OURS) == (name in ("quiver-s-1m", *QUIVERS))
    assert set(KINDS) >= set(SYSTEMS)
    with pytest.raises(ValueError, match="protocol=paper: emvd has quick and published"):
        protocol(system_named("emvd"), "paper")


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("unet", {"frames": 10}, "frames= must be at least 11, the window of unet, got 10"),
        ("rvrt", {"frames": 11}, "frames= must be at least 12, the window of rvrt, got 11"),
        ("spk2imgnet", {"frames": 9}, "at least 10"),
        ("emvd", {"crop": 36}, "crop=36: this network needs a multiple of 8"),
        ("memdeblur", {"crop": 24}, "multiple of 16"),
        ("rvrt", {"loss": "l1"}, "loss=l1: rvrt is trained with own; leave loss= out"),
        ("unet", {"loss": "own"}, "trained with published or paper or l1 or scales-l1"),
        ("mergenet", {"frames": 12}, "frames=12: mergenet restores from 11 frames; leave frames= out"),
        ("student-teacher", {"frames": 20}, "frames=20: student-teacher learns from 11 frames; leave frames= out"),
        ("bit2bit", {"schedule": "plateau"}, "schedule=plateau: follows validations, and bit2bit has none; leave it"),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_anything_is_written(
    tiny_dataset, tmp_path, name, changes, message
):
    network = tiny(name)
    with pytest.raises(ValueError, match=message):
        train(network, tiny_settings(network, tiny_dataset, tmp_path / "r", **changes), progress=False)
    assert not (tmp_path / "r").exists()


def test_batch_normalisation_of_memdeblur_needs_four_small_crops(tiny_dataset, tmp_path):
    """Two were advised: their gradient was not finite in the first step."""
    config = MemDeblurConfig(width=8, forward_blocks=1, backward_blocks=1, group_norm=False)
    network = MemDeblur(config)
    for batch in (1, 2, 3):
        with pytest.raises(ValueError, match="give batch=4"):
            train(network, tiny_settings(network, tiny_dataset, tmp_path / "r", batch=batch), progress=False)
        assert not (tmp_path / "r").exists()
    network = MemDeblur(replace(config, group_norm=True))
    once = {"steps": 1, "validate_every": 1, "validation_windows": 1, "crop": 32, "batch": 1}
    assert train(network, tiny_settings(network, tiny_dataset, tmp_path / "r", **once), progress=False).step == 1


def test_flornn_learns_over_more_frames_than_published():
    """With the published eleven, and a look-ahead of nine, its forward state is trained over one step."""
    network = FloRNN(FloRNNConfig(width=4, blocks=1, flow_channels=(4, 4)))
    system = system_of(network)
    quick, published = (Settings("d", "o", **{"steps": 1} | protocol(system, n)) for n in ("quick", "published"))
    assert (quick.frames, published.frames) == (20, 11)
    restored, first = system.restored(network, {"codes": torch.rand(1, quick.frames, 1, 16, 16)})
    assert (restored.shape, first) == ((1, 1, 1, 16, 16), quick.frames - 1 - network.look_ahead)


@pytest.mark.parametrize("name", ["emvd", "flornn", "memdeblur", "rvrt", "unet", "spk2imgnet"])
def test_validations_of_networks_with_a_state_are_as_long_as_training(name):
    network = tiny(name)
    system = system_of(network)
    run = Settings("d", "o", frames=40, steps=1)
    assert system.validated(network, run) == (40 if name not in ("unet", "spk2imgnet") else system.window(network))


def test_the_middle_frame_is_scored_of_any_window():
    """Of the published eleven or twelve frames that is frame 5."""
    for frames, middle in ((11, 5), (12, 5), (21, 10)):
        codes = torch.arange(frames, dtype=torch.float32).view(1, frames, 1, 1, 1)
        restored, first = centre_frame(torch.nn.Identity(), {"codes": codes})
        assert (first, restored.flatten().tolist()) == (middle, [middle])


def test_the_flow_of_flornn_weighs_the_same_for_any_number_of_frames():
    """A network that is off by the same in every frame, on a scene that moves: shares of the loss are equal."""
    network = FloRNN(FloRNNConfig(width=4, blocks=1, look_ahead=3, flow_channels=(4, 4)))
    shares = []
    for frames in (5, 10):
        target = torch.rand(1, 1, 1, 16, 16, generator=torch.Generator().manual_seed(0)).expand(1, frames, 1, 16, 16)
        target = torch.where(torch.arange(frames).view(1, -1, 1, 1, 1) % 2 == 0, target, 1 - target)
        still = torch.zeros(1, frames - 1, 2, 16, 16)
        network.flows = lambda codes, still=still: Flows(still, still)  # type: ignore[method-assign]
        losses = []
        for off in (0.0, 0.5):
            found = target[:, : frames - 3].expand(-1, -1, 3, -1, -1) + off
            network.restore = lambda images, noise, flows, found=found: found  # type: ignore[method-assign]
            batch = {"codes": target, "target": target}
            losses.append(float(system_of(network).loss(network, batch, Settings("d", "o", steps=1), 1.0)))
        shares.append(losses[0] / losses[1])
    assert 0 < shares[0] < 1
    assert shares[1] == pytest.approx(shares[0], rel=1e-4)


@pytest.mark.parametrize("name", ["rvrt", "memdeblur"])
def test_quick_crops_are_not_mostly_filled(name):
    """RVRT fills crops to 132 px, and MemDeblur has keys at a sixteenth of a quarter."""
    assert Settings("d", "o", steps=1, **protocol(system_named(name), "quick")).crop == 128


def test_flornn_needs_its_look_ahead_and_a_flow(tiny_dataset, tmp_path):
    for config, message in (
        (FloRNNConfig(width=4, blocks=1, look_ahead=11), "with a look-ahead of 11 frames FloRNN needs 12"),
        (FloRNNConfig(width=4, blocks=1, flow_channels=()), "has no flow network"),
    ):
        network = FloRNN(config)
        with pytest.raises(ValueError, match=message):
            train(network, tiny_settings(network, tiny_dataset, tmp_path / "r"), progress=False)


# ---- Inputs that are computed where samples are drawn


def moments(codes: Codes, sample: int) -> dict[str, Tensor]:
    """The mean code of a window, and what is known of its sensor and light."""
    mean = codes.read(0, codes.shape[0]).mean(axis=0, dtype=np.float32)
    known = [codes.sensor.bits, codes.white, codes.ppp or 0.0, codes.exposure]
    return {"mean": torch.from_numpy(mean), "known": torch.tensor(known)}


def test_windows_compute_inputs_from_codes_sensor_and_light(tiny_dataset):
    clips = open_clips(tiny_dataset, "train")
    plain = Windows(clips, WindowSettings(crop=16))
    more = Windows(clips, WindowSettings(crop=16), prepare=moments)
    for n in (0, 5):
        sample = more[n]
        assert set(sample) - set(plain[n]) == {"mean", "known"}
        assert torch.equal(sample["codes"], plain[n]["codes"])
        torch.testing.assert_close(sample["mean"] / 7, sample["codes"].mean(dim=0)[0])
        assert sample["known"].tolist() == pytest.approx([3, float(sample["white"]), 3.25, 5e-4])


def test_samples_hold_noisy_copies_of_the_centre_frame(tiny_dataset):
    """Their mean is the sensor's for the light of the centre frame; their noise is new in each, the codes as before."""
    clips = open_clips(tiny_dataset, "train")
    windows = Windows(clips, WindowSettings(crop=32, still=True))
    sample = windows[1]
    plain = Windows(clips, WindowSettings(crop=32))[1]
    assert torch.equal(sample["codes"], plain["codes"])
    still = sample["still"].numpy()[:, 0] * 7
    assert not np.array_equal(still[0], still[1])
    photons, _ = windows.photons_of(windows.place(1))
    sensor = windows.noise.noises[0].draw(clips[0]).sensor
    mean, variance = (np.asarray(law(photons[5], 5e-4)) for law in (sensor.mean, sensor.variance))
    z = (still.mean(axis=0) - mean) / np.sqrt(variance / len(still))
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / z.size) * 1.5


def test_a_network_is_trained_on_prepared_inputs(tiny_dataset, tmp_path, monkeypatch):
    """The loop hands what `prepare` returns to the loss and to the validation."""
    seen: list[float] = []
    base = system_of(tiny("unet"))

    def loss(network, batch, run, share):
        seen.append(float(batch["known"][0, 2]))
        return base.loss(network, batch, run, share)

    def restored(network, batch):
        assert batch["mean"].shape[0] == 1
        return base.restored(network, batch)

    mine = replace(base, loss=loss, restored=restored, prepare=moments)
    monkeypatch.setattr(training, "system_of", lambda network: mine)
    train(tiny("unet"), settings(tiny_dataset, tmp_path / "r", steps=2), progress=False)
    assert seen == pytest.approx([3.25, 3.25])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["emvd-as-published", "spk2imgnet-as-published", "flornn-as-published"])
def test_networks_as_published_are_trained(tiny_dataset, tmp_path, name):
    network = build(name)
    state = train(network, tiny_settings(network, tiny_dataset, tmp_path / "r", steps=1), progress=False)
    assert math.isfinite(state.history[-1]["loss"])
