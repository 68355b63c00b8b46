"""Defines the interface of every restorer: how it runs, and its entries in a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray as Array

from qsim.files import Progress
from quiver.data.codes import Codes
from quiver.device import HOST_MEMORY, default_memory, pick_device
from quiver.restoration.domain import Scope
from quiver.restoration.mosaics import fill_mosaic

AUTO = "auto"  # chooses the method of a stream: see automatic.py
DEFAULT_METHOD = AUTO  # of `quiver restore` and `quiver.restore`
# Presets: see quiver/model/presets.py. Those of equal cost: quiver/model/equal_cost.py.
QUIVERS = ("quiver-s", "quiver")
COMPARED = ("unet", "fastdvdnet", "student-teacher", "bit2bit", "emvd", "flornn", "memdeblur", "rvrt", "spk2imgnet")
NETWORKS = (
    *QUIVERS,
    "mergenet",
    *COMPARED,
    *(f"{name}-as-published" for name in ("emvd", "flornn", "memdeblur", "spk2imgnet")),
    *(f"{name}-1m" for name in ("quiver-s", "mergenet", *COMPARED)),
)
MODES = ("exact", "streaming", "windows")  # how a network shares work between frames, see quiver/model/schedules.py

# Adds the photons of frames `first` ... to zeros [t, H, W]; called with (codes, zeros, first, progress)
RestoreInto = Callable[[Codes, Array, int, Progress | None], None]


@dataclass(frozen=True)
class RestoreOptions:
    """Options of a run. Apart from `mode` and `precision` they change results by rounding only.

    There is one exception: a network whose complete frame exceeds the memory, which by default depends on the device.
    A warning then states the difference.
    """

    memory: int | None = None  # bytes of working memory; None = 2 GB, on a GPU half of its memory (`bound`)
    mode: str = "exact"  # exact = the published windows; streaming = state kept, faster; windows = recomputed
    device: str = "auto"  # one of quiver.device.DEVICES
    precision: str = "float32"  # or bfloat16

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(f"mode {self.mode!r}; known are {', '.join(MODES)}")
        if self.precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision {self.precision!r}; known are float32 and bfloat16")
        if self.memory is not None and self.memory < 1:
            raise ValueError(f"memory is in bytes and above 0, got {self.memory}")

    def bound(self, *, host: bool = False) -> int:
        """Return the working memory [bytes] on the device, or of what runs on the `host` alone."""
        if self.memory is not None:
            return self.memory
        return HOST_MEMORY if host else default_memory(pick_device(self.device))


@dataclass(frozen=True)
class Restorer:
    """A method that is ready to run, and its entries in a table."""

    name: str
    window: int  # frames used for one restored frame
    look_ahead: int  # of these, future ones
    learned: bool
    description: str
    fill: RestoreInto
    seamless: bool = True  # a range of frames restored alone equals the same frames of the complete stream
    identity: Mapping[str, object] = field(default_factory=dict)  # settings and weights that change the answer
    cut: Callable[[int, int], str] = lambda height, width: ""  # tiles of a frame, where they change the answer
    together: int = 1  # frames that are restored at a time and share most of the work
    scope: Scope | None = None  # of a network: the streams that it was measured for or trained on; None: not known
    device: str = "cpu"  # where it runs
    seen: int | None = None  # most frames used for one, if the first and the last of `window` are never used together

    @property
    def frames_used(self) -> int:
        """Most frames used for one restored frame."""
        return self.window if self.seen is None else self.seen

    def restore(self, codes: Codes, first: int = 0, last: int | None = None, progress: Progress | None = None) -> Array:
        """Return photons, float32 [last - first, H, W], of frames first ... last - 1; of all frames by default.

        Behind colour filters they are [last - first, 3, H, W], the photons of R, G and B.
        """
        length, *size = codes.video_shape
        out = np.zeros(((length if last is None else last) - first, *size), np.float32)
        self.into(codes, out, first, progress)
        return out

    def into(self, codes: Codes, out: Array, first: int, progress: Progress | None) -> None:
        """Write what `restore` returns of frames `first` ... into `out`, zeros of that shape."""
        if codes.colour is None:
            self.fill(codes, out, first, progress)
        else:
            fill_mosaic(self.fill, codes, out, first, progress)
