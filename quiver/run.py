"""A training run as a folder: its settings, its state, its files.

    settings.json  checkpoint.pt  best.safetensors  last.safetensors  history.json  curve.png
    failed.pt (only after NaN)  events.out.tfevents...

Every file is whole or absent. A folder accepts the settings it was made with and no others, so that a run that is
started again goes on where it stopped and never mixes two experiments.
"""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from quiver import weights
from quiver.data import Light, read_json, replacing, write_json
from quiver.loss import PRESETS as LOSSES
from quiver.optimiser import OPTIMISERS, Kind, Optimiser

SCHEDULES = ("cosine", "plateau")
PRECISIONS = ("auto", "float32", "bfloat16")


@dataclass(frozen=True)
class Settings:
    """Everything that decides a run; stored beside its results."""

    data: str  # data set folder
    out: str  # folder of the run
    network: str = "nano"  # name of the model, for the record
    steps: int | None = None  # optimiser steps; with `minutes`, whichever ends first
    minutes: float | None = None  # wall-clock limit, validation included
    sensor: str = "quiver-physical"
    ppp: tuple[float, ...] = (3.25,)  # light levels; every sample draws one
    bits: tuple[int, ...] = (3,)  # bit depths; every sample draws one
    crop: int = 64  # px
    frames: int = 11  # of a training window; each one beyond eleven is one more restored frame for little more work
    batch: int = 8  # of each process
    optimiser: Kind = "adam"  # or muon: see optimiser.py
    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.99)  # of Adam
    schedule: str = "cosine"  # or plateau
    warmup: int = 100  # steps of linear rise, at most a twentieth of the run
    patience: int = 8  # plateau: validations without gain before the rate is halved
    clip_norm: float = 20.0  # L2 norm of the gradient
    loss: str = "published"  # published, paper, l1 or scales-l1: see loss.py
    flips: bool = True  # the eight flips and quarter turns
    reverse: bool = True  # time reversal
    drift: int = 0  # px/frame; half of the crops move through their clip, up to so fast
    head_start: float = 0.0  # share of the run in which a baseline, if the network has one, is trained alone
    force_exposure: bool = False  # published: every window at the light level on its own
    validate_every: int = 300  # steps; a run without `steps` validates after every tenth of its time
    validation_split: str = "val"
    validation_windows: int = 16  # at most
    workers: int = 0  # processes that draw samples, beside the training one
    precision: str = "auto"  # float32, bfloat16; auto = bfloat16 on CUDA
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps is None and self.minutes is None:
            raise ValueError("a run needs an end: give --steps or --minutes")
        for name in ("steps", "minutes", "batch", "crop", "validate_every", "validation_windows", "learning_rate"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"--{name.replace('_', '-')} must be above 0, got {value!r}")
        if self.frames < 11:
            raise ValueError(f"--frames must be at least 11, the window of the networks, got {self.frames}")
        known_names = {"schedule": SCHEDULES, "precision": PRECISIONS, "loss": tuple(LOSSES), "optimiser": OPTIMISERS}
        for name, known in known_names.items():
            if getattr(self, name) not in known:
                raise ValueError(f"no {name} is called {getattr(self, name)!r}; known are {', '.join(known)}")

    @property
    def lights(self) -> tuple[Light, ...]:
        """Every combination of bit depth and light level."""
        return tuple(Light(self.sensor, ppp, bits) for bits in self.bits for ppp in self.ppp)

    def to_dict(self) -> dict[str, Any]:
        """As JSON gives it back: lists for tuples."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}


# Ours, and what the authors' program and the paper's text say (spec 5.2): bundles of defaults; options override.
_PUBLISHED = {"schedule": "plateau", "warmup": 0, "crop": 128, "reverse": False}
PROTOCOLS: dict[str, dict[str, Any]] = {
    "quick": {"optimiser": "muon", "learning_rate": 6e-3, "loss": "scales-l1", "drift": 3, "head_start": 0.85},
    "control": {"loss": "l1"},
    "published": _PUBLISHED
    | {"sensor": "quiver-published", "force_exposure": True, "learning_rate": 1e-4, "steps": 48_000},
    "paper": _PUBLISHED
    | {"sensor": "quiver-paper", "learning_rate": 2.5e-5, "batch": 4, "loss": "paper", "steps": 94_500},
    "spad-sum": {"sensor": "spad-320x240", "ppp": (4.9,)},
}


@dataclass
class State:
    """What changes during a run, apart from weights and optimiser."""

    step: int = 0
    elapsed: float = 0.0  # s
    best: float = -math.inf  # validation PSNR, dB
    plateau_best: float = -math.inf
    plateau_bad: int = 0
    halvings: int = 0
    tenths: int = 0  # of a timed run, validated so far
    finished: bool = False
    history: list[dict[str, float]] = field(default_factory=list)  # one entry per validation


class Run:
    """The folder of a run."""

    def __init__(self, settings: Settings) -> None:
        self.settings, self.folder = settings, Path(settings.out)
        self.checkpoint = self.folder / "checkpoint.pt"

    def open(self) -> None:
        """Make the folder, or check that it holds a run with these settings; FileExistsError if it does not."""
        path = self.folder / "settings.json"
        wanted = self.settings.to_dict()
        if not path.exists():
            if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
                raise FileExistsError(f"{self.folder} exists and is no training run; choose another -o")
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(path, wanted)
            return
        found = read_json(path)
        for name in wanted:
            if name not in ("out", "workers") and found.get(name) != wanted[name]:
                raise FileExistsError(
                    f"{self.folder} holds a run with {name} {found.get(name)!r}, now it is {wanted[name]!r}; "
                    "choose another -o, or start anew with --force"
                )

    def save(self, path: Path, model: nn.Module, optimiser: Optimiser, state: State, **extra: Any) -> None:
        """The whole state of the run in one file."""
        content = {
            "model": model.state_dict(),
            "optimiser": optimiser.state_dict(),
            "state": asdict(state),
            "torch_rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
            **extra,
        }
        with replacing(path) as file:
            torch.save(content, file)

    def load(self, model: nn.Module, optimiser: Optimiser, device: torch.device) -> State:
        """The newest state, put into model and optimiser; a fresh one if there is none, ValueError if it is damaged."""
        if not self.checkpoint.exists():
            return State()
        try:
            content = torch.load(self.checkpoint, map_location=device, weights_only=True)
            model.load_state_dict(content["model"])
            optimiser.load_state_dict(content["optimiser"])
            torch.set_rng_state(content["torch_rng"].cpu())
            if content["cuda_rng"] and torch.cuda.is_available():
                torch.cuda.set_rng_state_all([state.cpu() for state in content["cuda_rng"]])
            return State(**content["state"])
        except (RuntimeError, EOFError, KeyError, ValueError, TypeError, pickle.UnpicklingError) as error:
            reason = str(error).split(". ")[0].splitlines()[0]
            raise ValueError(
                f"{self.checkpoint}: not a state of this run ({reason}); start anew with --force"
            ) from None

    def save_weights(self, name: str, model: nn.Module, state: State) -> None:
        """NAME.safetensors with the settings in its notes; of folders only the name, because weights travel."""
        settings = self.settings.to_dict()
        settings |= {name: Path(settings[name]).name for name in ("data", "out")}
        notes = {"step": str(state.step), "settings": json.dumps(settings, sort_keys=True)}
        weights.save(model, model.config, self.folder / f"{name}.safetensors", notes)  # type: ignore[arg-type]

    def save_history(self, state: State) -> None:
        """The curve so far, one entry per validation."""
        write_json(self.folder / "history.json", {"settings": self.settings.to_dict(), "history": state.history})


def draw_curve(folder: Path) -> Path | None:
    """curve.png of a run from its history.json: validation PSNR and loss over minutes; None before any validation."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not (folder / "history.json").exists():
        return None
    history = read_json(folder / "history.json")["history"]
    minutes = [entry["elapsed"] / 60 for entry in history]
    canvas = FigureCanvasAgg(Figure(figsize=(6, 3.5), layout="constrained"))
    axes = canvas.figure.subplots()
    axes.plot(minutes, [entry["psnr_matched"] for entry in history], "o-", label="PSNR after the best factor")
    axes.plot(minutes, [entry["psnr"] for entry in history], ".--", label="PSNR raw")
    axes.set_xlabel("minutes")
    axes.set_ylabel("validation PSNR [dB]")
    losses = axes.twinx()
    losses.plot(minutes, [entry["loss"] for entry in history], ":", color="grey")
    losses.set_ylabel("training loss of one batch (dotted)")
    axes.legend(fontsize="small", loc="lower right")
    with replacing(folder / "curve.png") as file:
        canvas.figure.savefig(file, format="png", dpi=120)
    return folder / "curve.png"
