"""Declares how a clip is rendered: the settings that `qsim render` and recipes share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from qsim import limits, records
from qsim.kinds import FrameRate, Frames, Number, Psnr, Shutter, Text
from qsim.settings import setting

SIDE = 128  # px, height and width of a scene that states none


@dataclass(frozen=True)
class RenderSettings:
    """How a clip is rendered; `ValueError` for values out of their bounds."""

    frames: Annotated[Frames, setting("frames of the clip")] = 21
    height: Annotated[
        Frames | None, setting("height of the frames", unit="px", unset=f"the scene's, or {SIDE}", example=128)
    ] = None
    width: Annotated[
        Frames | None, setting("width of the frames", unit="px", unset=f"the scene's, or {SIDE}", example=128)
    ] = None
    frame_rate: Annotated[FrameRate, setting("frames per second of the scene's time", unit="Hz")] = 2000.0
    shutter: Annotated[Shutter, setting("open share of a frame; 0: sharp, with the light of a full frame")] = 0.0
    psnr: Annotated[Psnr, setting("wanted error of the radiance, below white, clamped there", unit="dB")] = 40.0
    bands: Annotated[Literal["rgb"] | None, setting("colour: bands R, G and B", unset="one band", example="rgb")] = None
    camera_path: Annotated[
        Text | None,
        setting(
            "poses, view and distortion of the camera, a transforms.json",
            unset="the scene's",
            shown="FILE",
            example="path.json",
        ),
    ] = None
    camera: Annotated[
        Text | None,
        setting("camera of a glTF file, by name", unset="chosen by the seed", example="Camera"),
    ] = None
    start: Annotated[
        Number | None,
        setting("time of a glTF file's animations at the first frame", unit="s", unset="0", example=0.5),
    ] = None
    reuse: Annotated[
        bool | None,
        setting(
            "sharp frames share samples with neighbours where that costs less; false: each alone",
            unset="where a trial costs little against the clip",
        ),
    ] = None

    def __post_init__(self) -> None:
        records.settle(self)
        height, width = self.size
        if height * width > limits.PIXELS:
            raise ValueError(f"frames of {height} x {width} pixels; at most {limits.PIXELS} pixels are rendered")

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [px] of the frames of a scene that states none."""
        return self.height or SIDE, self.width or SIDE

    @property
    def exposure(self) -> float:
        """Seconds of light per frame."""
        return (self.shutter or 1.0) / self.frame_rate
