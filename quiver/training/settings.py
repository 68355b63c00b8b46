"""Holds the settings of a training run, their defaults by protocol, and the noise that follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

import numpy as np

from qsim import records
from qsim.files import Blocked, Damaged, read_json
from qsim.kinds import Bits, Count, Frames, Light, Number, Part, Positive, Seed, Split, Text, Whole
from qsim.settings import setting
from qsim.words import positive_numbers
from quiver import threads
from quiver.data.clips import open_clips
from quiver.data.hot_pixels import Wanted
from quiver.data.illumination import Illumination, sensor_names
from quiver.data.mixture import Mixture, choose, describe
from quiver.model.names import NETWORKS
from quiver.restoration.settings import method_names
from quiver.training.loss import PRESETS as LOSSES
from quiver.training.optimiser import Kind
from quiver.training.saving import CHECKPOINT_SECONDS

LEVELS = 16  # of a range of light in training: from 0.3 to 100 photons they are a factor 1.47 apart


def light_levels(text: str) -> tuple[float, ...]:
    """Return light levels [photons] of a list, in which LOW..HIGH stands for LEVELS of them at equal ratios.

    Levels, not a continuum: the sensor follows the light, and each one has a table of its law.
    """
    found: list[float] = []
    for part in text.split(","):
        if ".." not in part:
            found += positive_numbers(part)
            continue
        ends = positive_numbers(part.replace("..", ",", 1))
        if not (len(ends) == 2 and ends[0] < ends[1]):
            raise ValueError(f"expected LOW..HIGH with LOW below HIGH, got {part!r}")
        found += [float(f"{level:.3g}") for level in np.geomspace(ends[0], ends[1], LEVELS)]
    return tuple(found)


@dataclass(frozen=True)
class Settings:
    """All that a run depends on; stored beside its results."""

    data: Annotated[
        str | tuple[Text, ...],
        setting(
            "data set folders, or a recipe to render meanwhile; for bit2bit a stored stream",
            positional=True,
        ),
    ]
    out: Annotated[
        str,
        setting(f"folder of the run; its state is saved every {CHECKPOINT_SECONDS:g} s", option="output", short="o"),
    ]
    network: Annotated[str, setting("network", option="preset", choices=NETWORKS)] = "mergenet"
    start: Annotated[
        Text | None,
        setting("weights to start from: a name that ships, a weights file or a run folder", known=method_names),
    ] = None  # the digest (weights.py) of their values; None: random weights
    steps: Annotated[Whole | None, setting("optimiser steps")] = None  # with `minutes`, what is reached first ends it
    minutes: Annotated[
        Positive | None, setting("wall-clock limit, validation included; the learning rate follows it")
    ] = None
    sensor: Annotated[
        str | tuple[Text, ...] | None,
        setting(
            "names of `qsim sensors` or .toml files, comma-separated",
            unset="the protocol's, which mergenet states, else those of the data set's streams",
            known=sensor_names,
        ),
    ] = None
    ppp: Annotated[
        tuple[Light, ...] | None,
        setting(
            f"mean photons per pixel and exposure; several: 1,10, or {LEVELS} in a range: 0.3..100",
            unset="the protocol's, else those of the streams",
            read=light_levels,
        ),
    ] = None
    bits: Annotated[
        tuple[Bits, ...] | None,
        setting("bits per code; several: 1,3", unset="the protocol's, else those of the streams"),
    ] = None
    planes: Annotated[
        Frames | None,
        setting(
            "clip frames of a code: planes of a clocked SPAD, else slices of an exposure",
            unset="those of the streams, else 1",
        ),
    ] = None
    temperature: Annotated[
        Number | None, setting("degrees C of sensor files with dark_doubling", unit="degrees C", unset="the files' own")
    ] = None
    noise: tuple[Illumination, ...] | None = None  # follows from these five, set by `settled`; every window draws one
    crop: Annotated[Whole, setting("px, side of the training windows", unset="the protocol's")] = 64
    frames: Annotated[
        Whole, setting("frames of a training window", unset="the protocol's, mostly 11; of 16, QUIVER restores six")
    ] = 11  # more give more restored frames, at low cost in QUIVER
    batch: Annotated[Whole, setting("windows per step and process", unset="the protocol's")] = 8
    # Losses are means over windows, so the gradient is that of the whole batch.
    accumulate: Annotated[Whole, setting("parts of a batch that are computed one after another, to save memory")] = 1
    optimiser: Annotated[Kind, setting("optimiser", unset="the protocol's")] = "adam"  # see optimiser.py
    learning_rate: Annotated[Positive, setting("highest learning rate", unset="the protocol's")] = 1e-3
    betas: tuple[float, float] = (0.9, 0.99)  # of Adam
    schedule: Annotated[
        Literal["cosine", "plateau"], setting("schedule of the learning rate", unset="the protocol's")
    ] = "cosine"
    warmup: int = 100  # steps of linear rise, at most a twentieth of the run
    patience: int = 8  # plateau: validations without gain before the rate is halved
    clip_norm: float = 20.0  # L2 norm of the gradient
    loss: Annotated[
        str,
        setting(
            "of quiver and unet; compared networks have their own", unset="the protocol's", choices=(*LOSSES, "own")
        ),
    ] = "published"  # see loss.py
    pretraining: Annotated[
        Part,
        setting("share of the run for QUIVER's pre-denoiser and flow alone", unset="the protocol's"),
    ] = 0.0  # from clean frames, see loss.parts_loss
    flips: bool = True  # the eight flips and quarter turns
    reverse: bool = True  # time reversal
    drift: int = 0  # px/frame, largest speed at which half of the crops move through their clip
    force_exposure: bool = False  # scale every window to the light level by its own mean, as published
    validate_every: Annotated[Whole, setting("steps between validations")] = (
        300  # without `steps` a run validates after every tenth of its time
    )
    validation_split: Annotated[Split, setting("split to validate on")] = "val"
    validation_windows: Whole = 16  # at most
    workers: Annotated[
        Count | None, setting("processes that draw samples", unset="0: this one; for a GPU most cores")
    ] = None
    windows: Annotated[
        Literal["auto", "host", "device"],
        setting("where windows are drawn", unset="auto: on a GPU if it can and holds the clips"),
    ] = "auto"  # the same windows, see device_windows.py
    pool: Annotated[
        Whole | None, setting("clips that windows are drawn from at a time; they turn over", unset="all")
    ] = None
    scan: Wanted = None
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"],
        setting("precision", unset="auto: bfloat16 on CUDA; published protocols: float32"),
    ] = "auto"
    compile: Annotated[Literal["off", "kernels", "graphs"], setting("torch.compile: fused kernels, or CUDA graphs")] = (
        "off"  # see compiling.py
    )
    seed: Annotated[Seed, setting("of weights, samples and noise")] = 0
    threads: Annotated[
        Whole | None,
        setting("torch threads on the CPU", unset="measured at start; resumed work keeps its number"),
    ] = None

    def __post_init__(self) -> None:
        if self.steps is None and self.minutes is None:
            raise ValueError("give a training length, as steps= or as minutes=")
        records.settle(self)
        if self.loss not in (*LOSSES, "own"):
            raise ValueError(f"no loss is called {self.loss!r}; known are {', '.join((*LOSSES, 'own'))}")
        if self.batch % self.accumulate:
            raise ValueError(
                f"batch={self.batch}: is no multiple of accumulate={self.accumulate}, and parts of a batch are equal; "
                "choose another of both"
            )

    @property
    def folders(self) -> tuple[str, ...]:
        """Return the data set folders."""
        return (self.data,) if isinstance(self.data, str) else self.data

    @property
    def together(self) -> int:
        """Return the windows that a process computes at once."""
        return self.batch // self.accumulate

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
            Illumination.of(sensor, ppp, bits, temperature=self.temperature).over(
                self.planes, bits if self.bits else None
            )
            for sensor in self.sensors or ("quiver-physical",)
            for bits in self.bits or (3,)
            for ppp in self.ppp or (3.25,)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as they are read from JSON: lists for tuples."""
        plain = {name: list(v) if isinstance(v, tuple) else v for name, v in vars(self).items()}
        return plain | {"noise": None if self.noise is None else [noise.to_dict() for noise in self.noise]}


class Protocol(TypedDict, total=False):
    """A bundle of defaults, which options override: some settings by the names and with the types of `Settings`."""

    sensor: str | tuple[str, ...]
    ppp: tuple[float, ...]
    bits: tuple[int, ...]
    crop: int
    frames: int
    batch: int
    optimiser: Kind
    learning_rate: float
    schedule: Literal["cosine", "plateau"]
    warmup: int
    clip_norm: float
    loss: str
    pretraining: float
    reverse: bool
    drift: int
    force_exposure: bool
    steps: int
    precision: Literal["auto", "float32", "bfloat16"]


# Ours, those of the authors' program, and those of the paper's text.
_PUBLISHED: Protocol = {
    "schedule": "plateau",
    "warmup": 0,
    "crop": 128,
    "reverse": False,
    "ppp": (3.25,),
    "bits": (3,),
    "precision": "float32",
}
PROTOCOLS: dict[str, Protocol] = {
    "quick": {"optimiser": "muon", "learning_rate": 6e-3, "loss": "scales-l1", "drift": 3},
    "control": {"loss": "l1"},
    "published": _PUBLISHED
    | {"sensor": "quiver-published", "force_exposure": True, "learning_rate": 1e-4, "steps": 48_000},
    "paper": _PUBLISHED
    | {"sensor": "quiver-paper", "learning_rate": 2.5e-5, "batch": 4, "loss": "paper", "steps": 94_500},
    "spad-sum": {"sensor": "spad-320x240", "ppp": (4.9,), "bits": (3,)},
}
_ASKED = ("sensor", "ppp", "bits", "planes", "temperature")


def settled(settings: Settings, *, force: bool = False) -> tuple[Settings, list[str]]:
    """Return the settings with the noise of the run, and lines about it; `ValueError` if it cannot be drawn.

    A folder that holds a run keeps its noise and its number of threads. Sensor, light levels and bit depths that are
    not given are those of that run.
    """
    if settings.noise is not None:
        return settings, Mixture(settings.noise).lines
    clips = open_clips(settings.data, "train")
    mixture = choose(clips, settings.sensors, settings.ppp, settings.bits, settings.temperature, settings.planes)
    path = Path(settings.out) / "settings.json"
    if force or not path.is_file():
        return replace(settings, noise=mixture.noises), mixture.lines
    found = read_json(path)
    try:
        given = {name: getattr(settings, name) for name in _ASKED}
        asked = {name: _as_tuple(found.get(name)) if value is None else value for name, value in given.items()}
        noise = _recorded(found)
        told = replace(settings, **asked, noise=noise, threads=settings.threads or threads.recorded(path))
    except (TypeError, ValueError) as error:
        raise Damaged(f"{path}: {error}; the file is damaged", "start again with force=True") from None
    files = tuple(name for name in settings.sensors or () if name.endswith(".toml"))
    if files and _of_files(mixture.noises) != _of_files(noise):
        raise Blocked(
            f"{settings.out} holds a run with noise: {describe(noise)}; {', '.join(files)} now describes other noise",
            "choose another folder, or start again with force=True",
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
