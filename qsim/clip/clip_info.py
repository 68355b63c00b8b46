"""Describes a clip: what clip.json holds, as one record.

    ClipInfo = what is asked for (shape, rates, unit, camera, ...), what it was made of (`Origin`, `Source`), and what
               its writer measured (`Measured`)

Fields that hold their default are not written. A key that no field has is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Final, Literal

from msgspec import Meta

from qsim import records
from qsim.clip.source import Source
from qsim.frame_times import Times
from qsim.kinds import Count, Digest, Name, NotNegative, Number, Positive, Split, Text, Whole, text_like
from qsim.optics.camera import Camera

PHYSICAL: Final = "W m^-2 sr^-1"
RELATIVE: Final = "relative"

Bands = tuple[Positive, Positive, Positive]  # wavelengths of R, G, B, m
MatrixRow = tuple[Number, Number, Number, Number]
Matrix = tuple[MatrixRow, MatrixRow, MatrixRow, MatrixRow]
FrameFile = Annotated[
    str,
    text_like(r"(radiance|sharp|truth|saturated)/[0-9]{6,}\.exr", "a name as radiance/000000.exr"),
]


@dataclass(frozen=True, kw_only=True)
class Saturation:
    """The pixel value at which the camera of an imported recording saturates."""

    white: NotNegative | None = None  # in the file's pixel values; None: not known
    assumed: bool = False  # it is the largest value that the pixels can hold


@dataclass(frozen=True, kw_only=True)
class FlickerInfo:
    """A light that flickers, and its mean strength over the exposure of each frame."""

    kind: Text  # Mains, RectifiedSine or PulseWidth
    frequency: Positive  # Hz
    phase: Number = 0.0  # rad
    depth: NotNegative | None = None  # of Mains
    duty: NotNegative | None = None  # of PulseWidth
    strength: Annotated[tuple[NotNegative, ...], Meta(min_length=1)]  # of each frame; 1 is the mean over time


@dataclass(frozen=True, kw_only=True)
class SceneName:
    """The scene that was rendered."""

    family: Text
    seed: Count = 0
    speed: Positive = 1.0  # factor on all motions


@dataclass(frozen=True)
class Finding:
    """One effect that a clip models or leaves out, and the size of the remaining error."""

    effect: str
    chosen: str
    size: str


@dataclass(frozen=True)
class Work:
    """The work for one rendered frame and the reasons for it."""

    samples: Whole = 32  # per pixel and frame, all instants and both halves together
    bounces: Whole = 6  # scatterings along a path
    sub_frames: Whole = 9  # instants per exposure when the shutter is open; their error is measured if 6, 9, 12 ...
    sharp: bool = True  # also render the instant at mid-exposure when the shutter is open
    denoise: bool = False  # Open Image Denoise; its error is measured against raw halves
    left_out: NotNegative = 0.0  # W m^-2 sr^-1, rms of later bounces by the pilot; part of the error of a frame
    left_out_at_white: NotNegative = 0.0  # the same of pictures clamped at white
    white: NotNegative = 0.0  # W m^-2 sr^-1, by the pilot; 0: unknown, each frame uses its own
    dimmed: Number = 0.0  # share of the mean light that later bounces would add, by the pilot
    dimmed_error: NotNegative = 0.0  # standard error of that share
    findings: tuple[Finding, ...] = ()
    neighbours: Count = 0  # frames on each side whose samples are carried into a frame (reuse/); 0: each frame alone
    quality: Text = "high"  # of the denoiser: high, balanced or fast; optix: that of a GPU
    planes: Whole = 1  # successive frames, from 0 on, that share the noise of a code (planes.py); 1: each frame alone
    codes: tuple[Whole, ...] = ()  # frames in a code of each kind, whose middle frames are sharp/; of `planes` > 1
    sharp_samples: Count = 0  # per pixel, of those sharp frames
    sharp_quality: str = ""  # of their denoiser; empty: none


@dataclass(frozen=True)
class RenderInfo(Work):
    """How a clip was rendered: the work for a frame, and the engine that did it."""

    engine: str = ""
    variant: str = ""


@dataclass(frozen=True, kw_only=True)
class Grouped:
    """The clip whose frames were averaged."""

    clip: Text
    frames: Whole  # in each mean


@dataclass(frozen=True, kw_only=True)
class Origin:
    """What a clip was made of: a scene and the files that it reads, and the job of a data set."""

    job: str = ""  # digest of the job
    split: Split | None = None
    scene: SceneName | None = None
    reads: dict[str, Digest] = field(default_factory=dict)  # the user's files that the scene reads
    assets: tuple[Text, ...] = ()  # pictures, meshes and photographs, by their content


@dataclass(frozen=True, kw_only=True)
class ErrorInfo:
    """The errors of a clip's frames, in the unit of its radiance, and their PSNR."""

    error_per_frame: tuple[NotNegative, ...] = ()  # rms
    error_at_white_per_frame: tuple[NotNegative, ...] = ()  # the same of pictures clamped at white
    error_per_code: tuple[NotNegative, ...] = ()  # rms of the mean of frames that share noise, or of its sharp middle
    error_at_white_per_code: tuple[NotNegative, ...] = ()  # the same of pictures clamped at white
    white: NotNegative | None = None
    psnr_of_truth: Number | None = None  # dB below white, clamped there, of codes where frames share noise, else frames
    psnr_unclamped: Number | None = None  # dB below white


@dataclass(frozen=True, kw_only=True)
class Measured(ErrorInfo):
    """What the writer of a clip measures, for the whole clip or in each frame."""

    mean_radiance: NotNegative = 0.0  # over frames, pixels and bands, in the unit of the clip
    mean_photons: NotNegative | None = None  # expected, per pixel, exposure and band; None: relative radiance
    clipped_pixels: Count = 0  # whose light is a lower bound, over all frames
    saturated_pixels: Count | None = None  # the same of imported recordings, and of clips of one band
    fireflies_per_frame: tuple[Count, ...] = ()  # pixels with implausible samples
    checksums: dict[FrameFile, Digest] = field(default_factory=dict)  # of each frame's files
    software: dict[str, str] = field(default_factory=dict)  # versions that decide the radiance


@dataclass(frozen=True, kw_only=True)
class ClipInfo(Measured, Origin):
    """The description of a clip: clip.json without its format version and its own checksum."""

    name: Name | None = None  # None: that of its folder
    shape: tuple[Whole, Whole, Whole]  # frames, height, width [px]
    frame_rate: Positive  # Hz, of the scene's time
    exposure: Positive  # s of light per frame
    shutter: NotNegative | None = None  # open share of a frame
    radiance_unit: Literal["W m^-2 sr^-1", "relative"] = RELATIVE
    camera: Camera | None = None  # without its motion; None: relative radiance
    poses: tuple[Matrix, ...] = ()  # camera to world at mid-exposure of each frame, of a camera that moves
    origin: tuple[Count, Count] = (0, 0)  # y, x of the first pixel in the camera's frame
    bands: Bands | None = None  # of a colour clip
    flicker: dict[str, FlickerInfo] = field(default_factory=dict)  # by light: light0, body3
    scene_sha256: Digest | None = None  # of the record of the scene
    seed: Count | None = None  # of the samples
    render: RenderInfo | None = None
    grouped: Grouped | None = None
    source: Source | None = None
    saturation: Saturation | None = None
    times: Times | None = None

    def __post_init__(self) -> None:
        records.settle(self)
        if self.poses and len(self.poses) != self.shape[0]:
            raise ValueError(f"poses: expected one for each of {self.shape[0]} frames, got {len(self.poses)}")
        if self.camera is not None and self.camera.motion is not None:
            if not self.poses:
                raise ValueError("poses: a camera that moves needs its pose in each frame")
            object.__setattr__(self, "camera", replace(self.camera, motion=None))
        if (self.camera is None) != (self.radiance_unit == RELATIVE):
            raise ValueError(f"a clip in {PHYSICAL} needs a camera, and a relative one has none")

    @property
    def orientation(self) -> str:
        """How rows and columns lie: as the source of an imported clip states it, else upright."""
        return (self.source.orientation if self.source is not None else "") or "upright"

    @property
    def asked(self) -> dict[str, object]:
        """The description without what is measured, as plain values: equal for clips of equal frames."""
        measured = {field.name for field in fields(Measured)}
        return {name: value for name, value in records.plain(self).items() if name not in measured}

    def has(self, folder: str, t: int) -> bool:
        """Return whether frame t has a file in a folder: radiance, sharp, truth or saturated."""
        return frame_file(folder, t) in self.checksums

    @property
    def has_sharp(self) -> bool:
        """Whether any frame has a picture at mid-exposure of its own."""
        return any(name.startswith("sharp/") for name in self.checksums)


def frame_file(folder: str, t: int) -> str:
    """Return the name of a frame's file: `radiance/000012.exr`."""
    return f"{folder}/{t:06d}.exr"
