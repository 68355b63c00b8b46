"""Declares the keys of a recipe: the records of its sections, from which reader, listing and JSON Schema are made.

    RecipeFile = Head [recipe] + ScenesSection [[scenes]] ... + StreamsSection [[streams]] ...

The settings of a clip are those of `RenderSettings`, and the settings of a stream those of `Sensing`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from msgspec import Meta

from qsim.dataset.series import Seeds
from qsim.kinds import Name, Seed, Speed, Split, Text
from qsim.rendering.render_settings import RenderSettings
from qsim.settings import section_of, setting
from qsim.streams.sensing import Sensing

Clips = Annotated[int, Meta(ge=1, le=1 << 31)]  # of a section
Speeds = Speed | Annotated[tuple[Speed, ...], Meta(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class HeadKeys:
    """The section [recipe]: name and seed of the data set, and the settings of all its clips."""

    name: Annotated[Name, setting("of the data set: letters, digits, '.', '_', '-'", example="starter")]
    seed: Annotated[Seed | None, setting("of the samples and of the noise", unset="0", example=1)] = None


@dataclass(frozen=True, kw_only=True)
class ScenesKeys:
    """A section [[scenes]]: one clip per seed and speed of a family."""

    family: Annotated[
        Text, setting('a family of scenes/; or a .py, .xml, .glb file or folder beside it ("./things")', example="fan")
    ]
    seeds: Annotated[Seeds | None, setting('one clip each, or "0..999"; or give count', example=[0, 1, 2])] = None
    count: Annotated[Clips | None, setting("clips of the seeds first ... first + count - 1", unset="1", example=3)] = (
        None
    )
    first: Annotated[Seed | None, setting("first seed of a count", unset="0", example=100)] = None
    speed: Annotated[Speeds, setting("factor on all motions, a number or a list", example=[1.0, 2.0])] = 1.0
    split: Annotated[Split, setting("split of the data set")] = "train"


@dataclass(frozen=True, kw_only=True)
class StreamsKeys:
    """A section [[streams]]: one stream per bits and light level, in every clip."""

    LIGHT: ClassVar[tuple[str, ...]] = ("ppp", "lux", "absolute")  # one of them is needed

    absolute: Annotated[
        Literal[True] | None, setting("the light of the scene as it is, instead of ppp", example=True)
    ] = None


if TYPE_CHECKING:

    class Head(HeadKeys, RenderSettings):
        """The keys of [recipe]; settings that are not given are None."""

    class ScenesSection(ScenesKeys, RenderSettings):
        """The keys of [[scenes]]; settings that are not given are None."""

    class StreamsSection(StreamsKeys, Sensing):
        """The keys of [[streams]]; settings that are not given are None."""
else:
    Head = section_of("Head", RenderSettings, HeadKeys, needed=("frames", "height", "width"))
    ScenesSection = section_of("ScenesSection", RenderSettings, ScenesKeys)
    StreamsSection = section_of("StreamsSection", Sensing, StreamsKeys, needed=("sensor",))

SECTIONS = {"[recipe]": Head, "[[scenes]]": ScenesSection, "[[streams]]": StreamsSection}


@dataclass(frozen=True, kw_only=True)
class RecipeFile:
    """A recipe as it is written."""

    recipe: Head
    scenes: tuple[ScenesSection, ...] = ()
    streams: tuple[StreamsSection, ...] = ()
