"""Declares the settings of an evaluation, and the protocols that decide some of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypedDict

from qsim.kinds import Bits, Light, Positive, Seed, Text, Whole
from qsim.settings import setting
from quiver.data.illumination import sensor_names
from quiver.restoration.settings import method_names


class Protocol(TypedDict):
    """What a test of the paper decides: these settings cannot be given beside it."""

    split: None
    stream: None
    sensor: str
    bits: tuple[int, ...]
    planes: None
    peak: None
    published: bool


PROTOCOLS: dict[str, Protocol] = {
    name: {
        "split": None,
        "stream": None,
        "sensor": "quiver-published",
        "bits": (3,),
        "planes": None,
        "peak": None,
        "published": True,
    }
    for name in ("quiver-published", "x4k1000fps")
}


def method_and_all() -> list[str]:
    """Return the methods that need no training, and the word for all of them."""
    return [*method_names(), "all"]


@dataclass(frozen=True)
class EvaluateSettings:
    """Which methods are scored on which clips, in which light; or on the photon counts of a static object."""

    source: Annotated[
        str | None, setting("data set or clip folder; with a protocol the folder of a test set", positional=True)
    ] = None
    output: Annotated[Path | None, setting("folder for evaluation.md, .json, .png (needed for clips)", short="o")] = (
        None
    )
    methods: Annotated[
        tuple[Text, ...],
        setting(
            "comma-separated; `moment:3` uses a 3-frame window; `all` runs every method",
            unset="naive,moment",
            known=method_and_all,
        ),
    ] = ("naive", "moment")
    split: Annotated[Literal["train", "val", "test", "all"] | None, setting("split of a data set", unset="test")] = None
    stream: Annotated[
        Text | None, setting("score this stored stream of every clip, instead of sensing the clip now")
    ] = None
    sensor: Annotated[
        Text | None,
        setting("a name of `qsim sensors`, or a .toml file", unset="quiver-physical", known=sensor_names),
    ] = None
    ppp: Annotated[
        tuple[Light, ...] | None,
        setting("mean photons per pixel and code, or of a sum; several: 3.25,9.75,26", unset="3.25"),
    ] = None
    bits: Annotated[tuple[Bits, ...] | None, setting("bits per code", unset="3; of a .toml file its own")] = None
    seed: Annotated[Seed | None, setting("seed of the test noise or of the random splits", unset="0")] = None
    published: Annotated[bool, setting("expose, scale and score every window separately")] = False
    protocol: Annotated[
        Literal["quiver-published", "x4k1000fps"] | None,
        setting("the paper's test on I2-2000FPS or X4K1000FPS, read from the folders as they are published"),
    ] = None
    peak: Annotated[
        Positive | None,
        setting("photons per pixel that the scores refer to", unset="2.5 x the mean light"),
    ] = None
    static: Annotated[
        Path | None,
        setting(
            "photon counts [N,H,W] or [T,K,H,W], or binary planes to sum",
            shown="COUNTS",
        ),
    ] = None
    width: Annotated[
        Whole | None, setting("static: the .npy holds packed binary planes of this many pixels per row")
    ] = None
    frames: Annotated[Whole | None, setting("static: frames to restore from", unset="11")] = None
    splits: Annotated[Whole | None, setting("static: random splits", unset="3")] = None
    strict: Annotated[bool, setting("networks: refuse a stream outside their measured domain")] = False
    force: Annotated[bool, setting("replace an existing evaluation")] = False

    @property
    def named(self) -> str:
        """The data set, clip or test set."""
        assert self.source is not None  # the command checks it
        return self.source

    @property
    def folder(self) -> Path:
        """The folder of results."""
        assert self.output is not None  # the command checks it
        return self.output
