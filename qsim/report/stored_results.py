"""States what a page reads of the results that commands have stored; other keys of these files are not looked at.

A file of another program, or one that was changed by hand, is refused with the key that does not fit.
"""

from __future__ import annotations

from pathlib import Path
from typing import NotRequired, TypedDict, TypeVar

from qsim import files, records

Stored = TypeVar("Stored")


def read(path: Path, kind: type[Stored]) -> Stored:
    """Return the results in a file; `ValueError` with the key if one is missing or of another kind."""
    return records.convert(files.read_json(path), kind, str(path), cure="make it again")


class Validated(TypedDict):
    """One validation of a training run."""

    step: int
    elapsed: float  # s
    psnr_matched: float | None  # dB; None: it was not finite


class TrainingHistory(TypedDict):
    """history.json of a training run."""

    history: list[Validated]


class Interval(TypedDict):
    """A mean over scenes with half of its 95 % interval; the text "inf" stands for an infinite mean."""

    mean: float | str | None  # None: no scene has one
    half_width: float | str | None  # None, of one scene


class EvaluatedMethod(TypedDict):
    """A line of an evaluation: a method at one light level."""

    method: str
    light: str
    scores: dict[str, Interval]  # by name: psnr, psnr_matched, ssim_matched
    seconds_per_frame: float | None
    truth_psnr: float | str | None  # dB, of the rendered truth itself
    above_peak: NotRequired[float | str | None]  # share of the truth's pixels
    near_truth: NotRequired[list[str]]  # scores that are near those of the truth
    failures: NotRequired[list[str] | None]


class EvaluationPlan(TypedDict, total=False):
    """What an evaluation scores."""

    split: str | None
    test_set: str | None  # of the paper
    published: bool  # every window is scored separately


class Evaluation(TypedDict):
    """evaluation.json of `quiver evaluate`."""

    peak: str
    table: list[EvaluatedMethod]
    plan: NotRequired[EvaluationPlan]
    remarks: NotRequired[list[str]]


class StaticScore(TypedDict):
    """The scores of a method on real photons [dB]."""

    method: str
    psnr: float | str | None
    psnr_matched: float | str | None
    psnr_matched_spread: float | str | None
    psnr_as_measured: float | str | None


class StaticObject(TypedDict):
    """The scores on measured photons of a static object."""

    counts: str  # file
    bits: int
    frames: int
    peak: float  # photons
    scores: list[StaticScore]


class Reading(TypedDict):
    """The JSON of `qsim validate reading`: windows per second, and per second of processor time."""

    window_shape: list[int]
    clip_shape: list[int]
    clip: float
    clip_processor: float
    mp4: float
    mp4_processor: float
    wanted: float
    wanted_ratio: float
    ok: bool


class RenderedLevel(TypedDict):
    """A scene at one level of `qsim validate render`; keys of the naive loop begin with "obvious_"."""

    scene: str
    level: float  # dB, wanted
    psnr: float  # dB, reached
    stated_psnr: float
    samples: int
    bounces: int
    seconds: float
    obvious_seconds: float
    obvious_psnr: float
    ratio: float


class RenderingValidation(TypedDict):
    """The JSON of `qsim validate render`."""

    ok: bool
    median_ratio: float
    height: int
    width: int
    engine: str
    rows: list[RenderedLevel]


class MeasuredSensor(TypedDict):
    """A model on one engine, of `qsim validate sensors`."""

    model: str
    engine: str
    megapixels_per_second: float
    times_numpy: float | None
    cdf_error: float | None
    p_value: float | None
    z_mean: float | None
    z_variance: float | None
    mismatches_per_million: float | None


class HardCase(TypedDict):
    """A case in which a sensor's law is easily wrong."""

    name: str
    found: str
    ok: bool


class SensorValidation(TypedDict):
    """The JSON of `qsim validate sensors`."""

    ok: bool
    pixels: int  # of a draw
    rows: list[MeasuredSensor]
    cases: NotRequired[list[HardCase]]
