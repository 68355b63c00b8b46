"""Steps whose numbers are read later: the same runs, no waiting inside of a step, and nothing bad is stored."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from golden import TINY
from runs import same_weights, settings, small_network
from torch import Tensor, nn
from waiting import listed_waits

from quiver.model.blocks import Output
from quiver.model.mergenet import INPUTS, MergeNet, MergeNetConfig
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNetConfig
from quiver.model.weights import load
from quiver.training import loop as training
from quiver.training.ahead import Copy
from quiver.training.loop import Diverged, Trainer, train
from quiver.training.merge_training import NODES
from quiver.training.optimiser import Optimiser
from quiver.training.processes import Process
from quiver.training.run_folder import Run
from quiver.training.systems import system_of

AHEAD = 3


@pytest.fixture
def ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the host be some steps ahead, as of a GPU."""
    monkeypatch.setattr(training, "steps_ahead", lambda device: AHEAD)


def timeless(history: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{name: value for name, value in entry.items() if name != "elapsed"} for entry in history]


@pytest.mark.parametrize("optimiser", ["adam", "muon"])
def test_a_run_whose_numbers_are_read_later_is_the_same(tiny_dataset, tmp_path, monkeypatch, optimiser):
    shown: dict[bool, list[tuple[int, float, float, float]]] = {False: [], True: []}
    networks = {}
    states = {}
    for later in shown:
        monkeypatch.setattr(training, "steps_ahead", lambda device, later=later: AHEAD if later else 0)
        monkeypatch.setattr(training.Board, "step", lambda board, *words, later=later: shown[later].append(words))
        networks[later] = small_network()
        asked = settings(tiny_dataset, tmp_path / str(later), steps=7, validate_every=2, optimiser=optimiser)
        states[later] = train(networks[later], asked, progress=False)
    assert same_weights(networks[False], networks[True])
    assert timeless(states[False].history) == timeless(states[True].history)
    assert shown[False] == shown[True]
    assert [number for number, *_ in shown[True]] == list(range(1, 8))


class Poisoned(nn.Module):
    """Returns NaN from one of its calls with gradients on; a buffer counts them, as that of batch normalisation."""

    multiple = 4
    config = UNetConfig(1)

    def __init__(self, poisoned: int) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones(()))
        self.register_buffer("calls", torch.zeros(()))
        self.poisoned = poisoned

    def forward(self, x: Tensor) -> Output:
        learns = torch.is_grad_enabled()
        self.calls += learns
        bad = math.nan if learns and int(self.calls) == self.poisoned else 1.0
        full = x[:, 5:-5] * self.factor * bad
        return Output(x * self.factor, full, full[..., ::2, ::2], full[..., ::4, ::4])


def stopped(data: Path, out: Path, poisoned: int) -> tuple[str, dict[str, Any], nn.Module]:
    """Return the problem of a run that diverges, what it stored, and its network."""
    network = Poisoned(poisoned)
    with pytest.raises(Diverged) as error:
        train(network, settings(data, out, validate_every=3), progress=False)
    return error.value.problem.replace(str(out), ""), torch.load(out / "failed.pt", weights_only=True), network


@pytest.mark.parametrize("poisoned", range(1, 7))
def test_nan_is_never_lost_and_spoils_nothing(tiny_dataset, tmp_path, monkeypatch, poisoned):
    """At any of six steps, the last one too, with a validation after every third: as where every step is read."""
    at_once = stopped(tiny_dataset, tmp_path / "a", poisoned)
    monkeypatch.setattr(training, "steps_ahead", lambda device: AHEAD)
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)  # a state is stored after every step
    later = stopped(tiny_dataset, tmp_path / "b", poisoned)
    assert later[0] == at_once[0]
    assert f"step {poisoned - 1}: loss nan" in later[0]
    assert (later[1]["samples"], later[1]["keys"]) == (at_once[1]["samples"], at_once[1]["keys"])
    assert later[1]["state"]["step"] == at_once[1]["state"]["step"] == poisoned - 1
    assert torch.equal(later[1]["model"]["factor"], at_once[1]["model"]["factor"])
    assert torch.equal(later[2].factor, at_once[2].factor)
    assert int(later[1]["model"]["calls"]) == poisoned - 1
    stored = tmp_path / "b/checkpoint.pt"
    if poisoned > 1:
        kept = torch.load(stored, weights_only=True)
        assert kept["state"]["step"] == poisoned - 1
        assert torch.isfinite(kept["model"]["factor"])
    if poisoned > 3:
        assert all(bool(torch.isfinite(value).all()) for value in Optimised.tensors(kept))


class Optimised:
    """What a stored optimiser holds."""

    @staticmethod
    def tensors(kept: dict[str, Any]) -> list[Tensor]:
        states = [values for part in kept["optimiser"]["parts"] for values in part["state"].values()]
        return [tensor for values in states for tensor in values.values()]


@pytest.mark.parametrize("optimiser", ["adam", "muon"])
def test_a_copy_brings_all_back(optimiser):
    """Weights, moments and random states, also those from before the first step, in the memory of another copy."""
    network = small_network()
    steps = Optimiser(network, optimiser, 1e-2, (0.9, 0.99))  # type: ignore[arg-type]

    def step() -> Tensor:
        network.zero_grad()
        loss = network(torch.rand(1, 12, 1, 16, 16)).square().mean()
        loss.backward()
        steps.step(1e-2)
        return loss.detach()

    copy = Copy().take(network, steps)
    for _ in range(3):  # of step 0, whose optimiser has no state; then of steps 1 and 2 in the same memory
        first = step()
        second = step()
        weights = {name: value.clone() for name, value in network.state_dict().items()}
        copy.restore(network, steps)
        assert torch.equal(step(), first)
        assert torch.equal(step(), second)
        assert all(torch.equal(value, weights[name]) for name, value in network.state_dict().items())
        copy.take(network, steps)


class NotRead:
    """Stands for numbers on their way: asking for them fails."""

    def __init__(self, numbers: Tensor) -> None:
        assert numbers.shape == (2,)

    def values(self) -> list[float]:
        raise AssertionError("a step asked for its own numbers")


def batch_of(network: nn.Module, device: str) -> dict[str, Any]:
    """Return a batch of two windows on a device."""
    codes = torch.zeros(2, 13, 1, 16, 16, device=device)
    one = torch.ones(2, device=device)
    batch = {"codes": codes, "target": codes, "white": one, "peak": one, "sample": torch.arange(2), "key": ["a", "b"]}
    if isinstance(network, MergeNet):
        frame = torch.zeros(2, 16, 16, device=device)
        table = torch.zeros(2, NODES, device=device)
        channels = torch.zeros(2, INPUTS, 16, 16, device=device)
        batch |= {"channels": channels, "phi": frame, "deviation": frame, "top": one, "table": table}
    return batch


@pytest.mark.parametrize(
    ("name", "optimiser", "loss"),
    [
        ("quiver", "adam", "published"),
        ("quiver", "muon", "paper"),
        ("unet", "muon", "scales-l1"),
        ("mergenet", "muon", "own"),
    ],
)
def test_a_step_waits_for_nothing(tmp_path, monkeypatch, name, optimiser, loss):
    """On `meta`, where a look at a value is an error; a number that is copied there is listed."""
    monkeypatch.setattr(torch, "autocast", lambda *given, **named: contextlib.nullcontext())  # torch has none for it
    monkeypatch.setattr(training, "Reading", NotRead)
    monkeypatch.setattr(training, "steps_ahead", lambda device: AHEAD)
    makers = {"quiver": lambda: QUIVER(TINY), "unet": small_network, "mergenet": lambda: MergeNet(MergeNetConfig(4))}
    network = makers[name]().to("meta")
    asked = settings(Path("none"), tmp_path / "r", optimiser=optimiser, loss=loss, batch=2, accumulate=2)
    system = replace(system_of(network), prepare_batch=None)  # the batch has its inputs
    trainer = Trainer(network, Run(asked), None, Process(0, 1, torch.device("meta")), system)
    batch = batch_of(network, "meta")
    trainer.step(batch)  # makes what the optimiser keeps
    with listed_waits() as (waits, operators):
        trainer.step(batch)
    assert waits == []
    assert operators.count > 100


def test_what_waits_would_be_listed():
    frames = torch.zeros(3, device="meta")
    with listed_waits() as (waits, _):
        torch.tensor([1.0, 2.0], device="meta")
        frames.new_tensor([1.0])
        torch.zeros(3).to("meta")
        with pytest.raises(RuntimeError):
            frames.sum().item()
        with contextlib.suppress(RuntimeError, NotImplementedError):
            _ = frames[frames > 0]
    assert waits == ["tensor", "new_tensor", "_to_copy", "_local_scalar_dense", "index"]


def test_nothing_is_stored_of_steps_that_were_not_read(tiny_dataset, tmp_path, monkeypatch, ahead):
    """Every file of weights and states is written with no step pending."""
    pending: list[deque[Any]] = []
    made = Trainer.__init__

    def kept(self: Trainer, *words: Any) -> None:
        made(self, *words)
        pending.append(self.pending)

    def empty(*words: Any, **named: Any) -> None:
        assert not pending[0]

    monkeypatch.setattr(Trainer, "__init__", kept)
    for name in ("save", "save_weights", "save_history"):
        before = getattr(Run, name)
        monkeypatch.setattr(Run, name, lambda *w, before=before, **n: (empty(), before(*w, **n))[1])
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    network = small_network()
    train(network, settings(tiny_dataset, tmp_path / "r"), progress=False)
    assert same_weights(network, load(tmp_path / "r/last.safetensors"))
