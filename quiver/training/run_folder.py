"""A training run as a folder: its settings, its state, its files.

    settings.json  checkpoint.pt  best.safetensors  last.safetensors  history.json  curve.png
    failed.pt (only after NaN)  events.out.tfevents...  lock

Every file is whole or absent, and one process at a time trains in a folder. A folder accepts the settings it was made
with and no others, so that the same command resumes, and two experiments are never mixed.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from qsim.files import check_ours, read_json, replacing, write_bytes, write_json
from qsim.locks import Lock
from quiver import threads
from quiver.data.clips import open_clips
from quiver.data.illumination import Illumination
from quiver.data.mixture import Mixture, choose, describe
from quiver.data.noise import Noise
from quiver.model import weights
from quiver.training.loss import PRESETS as LOSSES
from quiver.training.optimiser import OPTIMISERS, Kind, Optimiser

SCHEDULES = ("cosine", "plateau")
OURS = (  # what a run writes
    r"(settings|history)\.json|(checkpoint|failed(-\d+)?)\.pt|(best|last)\.safetensors|curve\.png|lock|"
    r"events\.out\.tfevents\..*"
)
LOCK = "lock"  # of a folder of results: held by the process that works in it
PRECISIONS = ("auto", "float32", "bfloat16")


@dataclass(frozen=True)
class Settings:
    """Everything that decides a run; stored beside its results."""

    data: str  # data set folder
    out: str  # folder of the run
    network: str = "nano"  # name of the model, for the record
    steps: int | None = None  # optimiser steps; with `minutes`, whichever ends first
    minutes: float | None = None  # wall-clock limit, validation included
    sensor: str | tuple[str, ...] | None = None  # as asked for; None: those of the data set's streams
    ppp: tuple[float, ...] | None = None  # light levels as asked for; None: those of the streams
    bits: tuple[int, ...] | None = None  # bit depths as asked for; None: those of the streams
    noise: tuple[Noise, ...] | None = None  # what these come to, filled in by `settled`; every window draws one
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
    threads: int | None = None  # of torch; None: measured

    def __post_init__(self) -> None:
        if self.steps is None and self.minutes is None:
            raise ValueError("a run needs an end: give --steps or --minutes")
        if self.threads is not None and (isinstance(self.threads, bool) or not isinstance(self.threads, int)):
            raise ValueError(f"--threads must be a whole number, got {self.threads!r}")
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
    def sensors(self) -> tuple[str, ...] | None:
        """Names or files of the sensors that are asked for."""
        return (self.sensor,) if isinstance(self.sensor, str) else self.sensor

    @property
    def lights(self) -> tuple[Illumination, ...]:
        """Every combination of sensor, bit depth and light level, with the defaults for what is not asked for."""
        if self.noise is not None:
            return self.noise
        return tuple(
            Illumination(sensor, ppp, bits)
            for sensor in self.sensors or ("quiver-physical",)
            for bits in self.bits or (3,)
            for ppp in self.ppp or (3.25,)
        )

    def to_dict(self) -> dict[str, Any]:
        """As JSON gives it back: lists for tuples."""
        plain = {name: list(v) if isinstance(v, tuple) else v for name, v in vars(self).items()}
        return plain | {"noise": None if self.noise is None else [noise.to_dict() for noise in self.noise]}


# Ours, and what the authors' program and the paper's text say (spec 5.2): bundles of defaults; options override.
_PUBLISHED = {"schedule": "plateau", "warmup": 0, "crop": 128, "reverse": False, "ppp": (3.25,), "bits": (3,)}
PROTOCOLS: dict[str, dict[str, Any]] = {
    "quick": {"optimiser": "muon", "learning_rate": 6e-3, "loss": "scales-l1", "drift": 3, "head_start": 0.85},
    "control": {"loss": "l1"},
    "published": _PUBLISHED
    | {"sensor": "quiver-published", "force_exposure": True, "learning_rate": 1e-4, "steps": 48_000},
    "paper": _PUBLISHED
    | {"sensor": "quiver-paper", "learning_rate": 2.5e-5, "batch": 4, "loss": "paper", "steps": 94_500},
    "spad-sum": {"sensor": "spad-320x240", "ppp": (4.9,), "bits": (3,)},
}
_ASKED = ("sensor", "ppp", "bits")


def settled(settings: Settings, *, force: bool = False) -> tuple[Settings, list[str]]:
    """The settings with the noise of a run, and what there is to say of it; `ValueError` where it cannot be drawn.

    A folder that holds a run keeps its noise and its number of threads, and what is not asked for is what was asked for
    then.
    """
    if settings.noise is not None:
        return settings, Mixture(settings.noise).lines
    clips = open_clips(settings.data, "train")
    mixture = choose(clips, settings.sensors, settings.ppp, settings.bits)
    path = Path(settings.out) / "settings.json"
    if force or not path.is_file():
        return replace(settings, noise=mixture.noises), mixture.lines
    found = read_json(path)
    try:
        asked = {name: getattr(settings, name) or _as_tuple(found.get(name)) for name in _ASKED}
        noise = _recorded(found)
        told = replace(settings, **asked, noise=noise, threads=settings.threads or threads.recorded(path))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}; the file is damaged, start again with --force") from None
    files = tuple(name for name in settings.sensors or () if name.endswith(".toml"))
    if files and "noise" in found and set(mixture.noises) != set(noise):
        raise FileExistsError(
            f"{settings.out} holds a run with noise: {describe(noise)}; {', '.join(files)} says something else now; "
            "choose another -o, or start again with --force"
        )
    return told, Mixture(noise, "as this run began", mixture.streams).lines


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _recorded(found: Mapping[str, Any]) -> tuple[Noise, ...]:
    """The noise of a run from its settings; runs of earlier versions had sensor, bits and ppp, and drew no defects."""
    if found.get("noise") is not None:
        if not isinstance(found["noise"], list) or not found["noise"]:
            raise ValueError(f"noise is {_short(found['noise'])}")
        return tuple(Noise.from_dict(values) for values in found["noise"])
    old = Settings("", "", steps=1, **{name: _as_tuple(found.get(name)) for name in _ASKED})
    return tuple(replace(Noise.of(light), defects=None) for light in old.lights)


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

    @classmethod
    def from_dict(cls, values: Any) -> State:
        """What `asdict` gave; strict, ValueError."""
        kinds = {field.name: field.type for field in fields(cls)}
        if not isinstance(values, dict) or set(values) != set(kinds):
            raise ValueError(f"a state has {', '.join(kinds)}")
        for name, value in values.items():
            kind = type(value).__name__
            if name == "history":
                good = isinstance(value, list) and all(_is_entry(entry) for entry in value)
            elif kinds[name] == "int":
                good = kind == "int" and 0 <= value < 2**53
            else:
                good = kind == kinds[name] and value == value  # nothing is NaN
            if not good:
                raise ValueError(f"{name} is {repr(value)[:60]}")
        if values["elapsed"] < 0 or math.isinf(values["elapsed"]):
            raise ValueError(f"elapsed is {values['elapsed']}")
        return cls(**values)


def _is_entry(entry: Any) -> bool:
    """Whether this is one validation's numbers, as `train` writes them."""
    return (
        isinstance(entry, dict)
        and {"step", "elapsed", "loss", "psnr", "psnr_matched"} <= entry.keys()
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in entry.values())
    )


def _load_weights(model: nn.Module, stored: Any) -> None:
    """Put stored weights into the model; ValueError unless they are all there, in their shapes, and finite."""
    own = model.state_dict()
    if not isinstance(stored, dict) or not all(isinstance(name, str) for name in stored):
        raise ValueError("weights of another network")
    stored = weights.current_names(stored)
    if set(stored) != set(own):
        raise ValueError("weights of another network")
    for name, value in stored.items():
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided or value.shape != own[name].shape:
            raise ValueError(f"{name} is not a tensor of shape {list(own[name].shape)}")
        if value.dtype != own[name].dtype or not bool(torch.isfinite(value).all()):
            raise ValueError(f"{name} holds values that are not finite numbers of the kind {own[name].dtype}")
    model.load_state_dict(stored)


@contextlib.contextmanager
def alone_in(folder: Path, doing: str) -> Iterator[None]:
    """Hold the lock of a folder of results; `ValueError` if another process holds it."""
    lock = Lock(folder / LOCK)
    if not lock.acquire():
        raise ValueError(f"{folder}: another process {doing} here; wait for it to end, or choose another -o")
    try:
        yield
    finally:
        lock.delete()


def empty(folder: Path) -> None:
    """Remove all but the lock, which the caller holds; settings.json last, so that it stays ours until then."""
    for path in sorted(folder.iterdir(), key=lambda path: path.name == "settings.json"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]} ..."


class Run:
    """The folder of a run."""

    def __init__(self, settings: Settings) -> None:
        self.settings, self.folder = settings, Path(settings.out)
        self.checkpoint = self.folder / "checkpoint.pt"

    @contextlib.contextmanager
    def open(self, *, force: bool = False) -> Iterator[None]:
        """Make the folder, or check that it holds a run with these settings, and keep others out while it is open.

        `force` begins again where a run is. `FileExistsError` if the folder holds something else or a run with other
        settings, `ValueError` while another process trains in it.
        """
        self._check_ours(force)
        self.folder.mkdir(parents=True, exist_ok=True)
        with alone_in(self.folder, "trains"):
            self._check_ours(force)
            if force:
                check_ours(self.folder, OURS)
                empty(self.folder)
            path = self.folder / "settings.json"
            if not path.exists():
                write_json(path, self.settings.to_dict())
            self._check_settings()
            found = read_json(path)
            if found.get("threads") != self.settings.threads:
                write_json(path, found | {"threads": self.settings.threads})
            yield

    def _check_ours(self, force: bool) -> None:
        folder = self.folder
        if (folder / "settings.json").is_file() or not folder.exists():
            return
        if not folder.is_dir() or any(path.name != LOCK for path in folder.iterdir()):
            if force:
                raise FileExistsError(f"{folder} holds no settings.json; --force removes only what this command made")
            raise FileExistsError(f"{folder} exists and is no training run; choose another -o")

    def _check_settings(self) -> None:
        wanted, found = self.settings.to_dict(), read_json(self.folder / "settings.json")
        free = {"out", "workers", "threads"} | ({"noise"} - found.keys())  # earlier versions wrote no noise
        for name in wanted:
            if name not in free and found.get(name) != wanted[name]:
                before = "as in its data set" if found.get(name) is None else _short(found[name])
                raise FileExistsError(
                    f"{self.folder} holds a run with {name} {before}, now it is {_short(wanted[name])}; choose "
                    "another -o, or start again with --force"
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
        buffer = io.BytesIO()  # a disk that is full halfway is then the system's error, not torch's
        torch.save(content, buffer)
        write_bytes(path, buffer.getbuffer())

    def load(self, model: nn.Module, optimiser: Optimiser, device: torch.device) -> State:
        """The newest state, put into model and optimiser; a fresh one if there is none, ValueError if it is damaged."""
        if not self.checkpoint.exists():
            return State()
        try:
            content = weights.read_torch(self.checkpoint, device)
            if not isinstance(content, dict):
                raise ValueError(f"it holds a {type(content).__name__}")
            state = State.from_dict(content["state"])
            _load_weights(model, content["model"])
            optimiser.load_state_dict(content["optimiser"])
            torch.set_rng_state(content["torch_rng"].cpu())
            if content["cuda_rng"] and torch.cuda.is_available():
                torch.cuda.set_rng_state_all([state.cpu() for state in content["cuda_rng"]])
            return state
        except weights.DAMAGE as error:
            raise ValueError(
                f"{self.checkpoint}: not a state of this run ({weights.short_reason(error)}); start again with --force"
            ) from None

    def save_weights(self, name: str, model: nn.Module, state: State) -> None:
        """NAME.safetensors with the settings in its notes; of folders only the name, because weights travel."""
        settings = portable(self.settings)
        notes = {"step": str(state.step), "settings": json.dumps(settings, sort_keys=True)}
        weights.save(model, model.config, self.folder / f"{name}.safetensors", notes)  # type: ignore[arg-type]

    def save_history(self, state: State) -> None:
        """The curve so far, one entry per validation."""
        write_json(self.folder / "history.json", {"settings": self.settings.to_dict(), "history": state.history})


def portable(settings: Settings) -> dict[str, Any]:
    """Settings for a weights file: of folders and files only the names; sensor, ppp and bits are those of the noise."""
    found = settings.to_dict()
    found |= {name: Path(found[name]).name for name in ("data", "out")}
    for noise in found["noise"] or ():
        noise["sensor"] = Path(noise["sensor"]).name
        for value in (noise["defects"] or {}).values():
            if isinstance(value, dict) and "file" in value:
                value["file"] = Path(value["file"]).name
    if found["noise"]:
        sensors = list(dict.fromkeys(noise["sensor"] for noise in found["noise"]))
        found["sensor"] = sensors[0] if len(sensors) == 1 else sensors
        for name in ("ppp", "bits"):
            found[name] = list(dict.fromkeys(noise[name] for noise in found["noise"] if noise[name] is not None))
    return found


def draw_curve(folder: Path, history: Sequence[Mapping[str, float]]) -> Path | None:
    """curve.png of a run: validation PSNR and loss over minutes; None before any validation."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not history:
        return None
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
