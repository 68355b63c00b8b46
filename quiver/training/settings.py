"""Holds the settings of a training run, their defaults by protocol, and the noise that follows from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qsim.files import read_json
from quiver import threads
from quiver.data.clips import open_clips
from quiver.data.illumination import Illumination
from quiver.data.mixture import Mixture, choose, describe
from quiver.training.loss import PRESETS as LOSSES
from quiver.training.optimiser import OPTIMISERS, Kind

SCHEDULES = ("cosine", "plateau")
PRECISIONS = ("auto", "float32", "bfloat16")


@dataclass(frozen=True)
class Settings:
    """All that a run depends on; stored beside its results."""

    data: str | tuple[str, ...]  # data set folder, or several
    out: str  # folder of the run
    network: str = "mergenet"  # name of the model, for the record
    start: str | None = None  # digest (weights.py) of the weights that the run starts from; None: random weights
    steps: int | None = None  # of the optimiser; with `minutes` too, the limit that is reached first ends the run
    minutes: float | None = None  # wall-clock limit, validation included
    sensor: str | tuple[str, ...] | None = None  # as given; None: those of the data set's streams
    ppp: tuple[float, ...] | None = None  # light levels as given; None: those of the streams
    bits: tuple[int, ...] | None = None  # bit depths as given; None: those of the streams
    noise: tuple[Illumination, ...] | None = None  # follows from these three, set by `settled`; every window draws one
    crop: int = 64  # px
    frames: int = 11  # of a training window; more give more restored frames, at low cost in QUIVER
    batch: int = 8  # of each process
    optimiser: Kind = "adam"  # or muon: see optimiser.py
    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.99)  # of Adam
    schedule: str = "cosine"  # or plateau
    warmup: int = 100  # steps of linear rise, at most a twentieth of the run
    patience: int = 8  # plateau: validations without gain before the rate is halved
    clip_norm: float = 20.0  # L2 norm of the gradient
    loss: str = "published"  # published, paper, l1, scales-l1: see loss.py; own: that of a compared network
    flips: bool = True  # the eight flips and quarter turns
    reverse: bool = True  # time reversal
    drift: int = 0  # px/frame, largest speed at which half of the crops move through their clip
    force_exposure: bool = False  # scale every window to the light level by its own mean, as published
    validate_every: int = 300  # steps; without `steps` a run validates after every tenth of its time
    validation_split: str = "val"
    validation_windows: int = 16  # at most
    workers: int = 0  # processes that draw samples; 0: the training process does
    precision: str = "auto"  # float32, bfloat16; auto = bfloat16 on CUDA
    seed: int = 0
    threads: int | None = None  # of torch; None: measured

    def __post_init__(self) -> None:
        if self.steps is None and self.minutes is None:
            raise ValueError("give a training length: --steps N or --minutes M")
        if self.threads is not None and (isinstance(self.threads, bool) or not isinstance(self.threads, int)):
            raise ValueError(f"--threads must be a whole number, got {self.threads!r}")
        for name in (
            "steps",
            "minutes",
            "batch",
            "crop",
            "frames",
            "validate_every",
            "validation_windows",
            "learning_rate",
        ):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"--{name.replace('_', '-')} must be above 0, got {value!r}")
        known_names = {
            "schedule": SCHEDULES,
            "precision": PRECISIONS,
            "loss": (*LOSSES, "own"),
            "optimiser": OPTIMISERS,
        }
        for name, known in known_names.items():
            if getattr(self, name) not in known:
                raise ValueError(f"no {name} is called {getattr(self, name)!r}; known are {', '.join(known)}")

    @property
    def folders(self) -> tuple[str, ...]:
        """Return the data set folders."""
        return (self.data,) if isinstance(self.data, str) else self.data

    @property
    def sensors(self) -> tuple[str, ...] | None:
        """Return the names or files of the given sensors."""
        return (self.sensor,) if isinstance(self.sensor, str) else self.sensor

    @property
    def lights(self) -> tuple[Illumination, ...]:
        """Return every combination of sensor, bit depth and light level, with defaults for those not given."""
        if self.noise is not None:
            return self.noise
        return tuple(
            Illumination.of(sensor, ppp, bits)
            for sensor in self.sensors or ("quiver-physical",)
            for bits in self.bits or (3,)
            for ppp in self.ppp or (3.25,)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as they are read from JSON: lists for tuples."""
        plain = {name: list(v) if isinstance(v, tuple) else v for name, v in vars(self).items()}
        return plain | {"noise": None if self.noise is None else [noise.to_dict() for noise in self.noise]}


# Bundles of defaults, which options override: ours, those of the authors' program, and those of the paper's text.
_PUBLISHED = {
    "schedule": "plateau",
    "warmup": 0,
    "crop": 128,
    "reverse": False,
    "ppp": (3.25,),
    "bits": (3,),
    "precision": "float32",
}
PROTOCOLS: dict[str, dict[str, Any]] = {
    "quick": {"optimiser": "muon", "learning_rate": 6e-3, "loss": "scales-l1", "drift": 3},
    "control": {"loss": "l1"},
    "published": _PUBLISHED
    | {"sensor": "quiver-published", "force_exposure": True, "learning_rate": 1e-4, "steps": 48_000},
    "paper": _PUBLISHED
    | {"sensor": "quiver-paper", "learning_rate": 2.5e-5, "batch": 4, "loss": "paper", "steps": 94_500},
    "spad-sum": {"sensor": "spad-320x240", "ppp": (4.9,), "bits": (3,)},
}
_ASKED = ("sensor", "ppp", "bits")


def settled(settings: Settings, *, force: bool = False) -> tuple[Settings, list[str]]:
    """Return the settings with the noise of the run, and lines about it; `ValueError` if it cannot be drawn.

    A folder that holds a run keeps its noise and its number of threads. Sensor, light levels and bit depths that are
    not given are those of that run.
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
    if files and _of_files(mixture.noises) != _of_files(noise):
        raise FileExistsError(
            f"{settings.out} holds a run with noise: {describe(noise)}; {', '.join(files)} now describes other noise; "
            "choose another -o, or start again with --force"
        )
    return told, Mixture(noise, "as this run began", mixture.streams).lines


def _of_files(noises: tuple[Illumination, ...]) -> set[tuple[str, str | None, str | None]]:
    """Return what the sensor files among noises state; light and bits of a stored run may be those of other streams."""
    return {(noise.sensor, noise.record, noise.defects) for noise in noises if noise.sensor.endswith(".toml")}


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _recorded(found: Mapping[str, Any]) -> tuple[Illumination, ...]:
    """Return the noise of a stored run; `ValueError` if it is no list of them."""
    noises = found.get("noise")
    if not isinstance(noises, list) or not noises:
        raise ValueError(f"noise is {short(noises)}")
    return tuple(Illumination.from_dict(values) for values in noises)


def portable(settings: Settings) -> dict[str, Any]:
    """Return settings for a weights file: names without folders; sensor, ppp and bits are those of the noise."""
    found = settings.to_dict()
    folders = [Path(folder).name for folder in settings.folders]
    found |= {"data": folders[0] if len(folders) == 1 else folders, "out": Path(settings.out).name}
    for noise in found["noise"] or ():
        noise["sensor"] = Path(noise["sensor"]).name
        for value in (noise["defects"] or {}).values():
            if isinstance(value, dict) and "file" in value:
                value["file"] = Path(value["file"]).name
    drawn = [noise["sensor"] for noise in found["noise"] or ()]  # none for bit2bit, which has the sensor of its stream
    sensors = list(dict.fromkeys(drawn or [Path(name).name for name in settings.sensors or ()]))
    found["sensor"] = sensors[0] if len(sensors) == 1 else sensors or None
    if found["noise"]:
        for name in ("ppp", "bits"):
            found[name] = list(dict.fromkeys(noise[name] for noise in found["noise"] if noise[name] is not None))
    return found


def short(value: Any) -> str:
    """Return a value as text for a message, at most 200 characters of it."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]} ..."
