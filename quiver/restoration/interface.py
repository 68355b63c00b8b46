"""Defines the interface of every restorer: how it runs, and its entries in a table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy import ndarray as Array

from qsim.files import Progress
from qsim.kinds import Whole
from qsim.settings import setting, settle
from qsim.words import memory_size
from quiver.data.codes import Codes, light_of
from quiver.device import DEVICES, HOST_MEMORY, default_memory, pick_device
from quiver.host import own_numbers
from quiver.restoration.domain import UP_TO_A_FACTOR, Scope, place_of, remark
from quiver.restoration.learned_bands import LearnedBands
from quiver.restoration.mosaics import by_colour, fill_mosaic

AUTO = "auto"  # chooses the method of a stream: see automatic.py
DEFAULT_METHOD = AUTO  # of `quiver restore` and `quiver.restore`
PRECISIONS = ("float32", "bfloat16")
MODES = ("exact", "streaming", "windows")  # how a network shares work between frames, see quiver/model/schedules.py

# Adds the photons of frames `first` ... to zeros [t, H, W]; called with (codes, zeros, first, progress)
RestoreInto = Callable[[Codes, Array, int, Progress | None], None]


@dataclass(frozen=True)
class RestoreOptions:
    """Options of a run. Apart from `mode` and `precision` they change results by rounding only.

    There is one exception: a network whose complete frame exceeds the memory, which by default depends on the device.
    A warning then states the difference.
    """

    memory: Annotated[
        Whole | None,
        setting(
            "working memory, as in 500MB",
            unset="2GB; on a GPU half of its memory",
            read=memory_size,
        ),
    ] = None  # bytes
    mode: Annotated[
        str,
        setting("networks: how frames share work, exact for the published windows, streaming is faster", choices=MODES),
    ] = "exact"
    device: Annotated[str, setting("where methods run", choices=DEVICES)] = "auto"
    precision: Annotated[str, setting("networks: precision", choices=PRECISIONS)] = "float32"

    def __post_init__(self) -> None:
        settle(self)

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
    any_device: bool = True  # whether the device can be chosen; a method of others computes where it will
    bands: LearnedBands | None = None  # R, G and B of the light behind colour filters; None: the linear estimate
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

    @own_numbers
    def into(self, codes: Codes, out: Array, first: int, progress: Progress | None) -> None:
        """Write what `restore` returns of frames `first` ... into `out`, zeros of that shape."""
        if self.bands is not None:
            self.bands.check(codes)
        last = first + len(out)
        for scene in scenes(codes):
            start = max(first, scene.start)
            stop = min(last, scene.stop)
            if start < stop:
                shown = within(progress, start - first, len(out), stop - start)
                part = out[start - first : stop - first]
                self._fill_scene(codes_between(codes, scene), part, start - scene.start, shown)

    def _fill_scene(self, codes: Codes, out: Array, first: int, progress: Progress | None) -> None:
        if codes.colour is None:
            self.fill(codes, out, first, progress)
        else:
            fill_mosaic(self.fill, codes, out, first, progress, self.bands or Codes.demosaiced)


# ---- Scenes of a stream


def scenes(codes: Codes) -> list[range]:
    """Return the frames of each scene of a stream, one after the other: all of them if it has no cut."""
    edges = [0, *codes.cuts, codes.shape[0]]
    return [range(first, last) for first, last in pairwise(edges)]


def codes_between(codes: Codes, frames: range) -> Codes:
    """Return the codes of successive frames of a stream, as a stream without a cut."""
    if len(frames) == codes.shape[0]:
        return codes

    def read(start: int, stop: int) -> Array:
        return codes.read(frames.start + start, frames.start + stop)

    return replace(codes, shape=(len(frames), *codes.shape[1:]), read=read, cuts=(), faulty=())


def within(progress: Progress | None, before: int, total: int, frames: int) -> Progress | None:
    """Return the progress of some frames as that of `total` ones, of which so many are before them."""
    if progress is None or frames == total:
        return progress
    return lambda done, of: progress(before + done * frames // of, total)


# ---- What is said of methods on a stream


def remarks(methods: Iterable[Restorer], codes: Codes) -> list[str]:
    """Return the remarks on all networks among the methods."""
    return [text for method in methods for text in _remarks(method, codes)]


def _remarks(method: Restorer, codes: Codes) -> list[str]:
    """Return the different remarks on a method, of a mosaic on the light of each colour, which is restored alone.

    None for a classical one, and where there is nothing to say.
    """
    if method.scope is None:
        return []
    said = [remark(method.name, method.scope, part) or _run_unlike(method) for part in by_colour(codes)]
    if method.scope.relative:
        said = [f"{text or f'{method.name} was converted'}; {UP_TO_A_FACTOR}" for text in said]
    return list(dict.fromkeys(text for text in said if text is not None))


def _run_unlike(method: Restorer) -> str | None:
    """Return the remark on a network that runs otherwise than when it was measured: in mode or precision."""
    if method.scope is None or method.scope.domain is None:
        return None
    usual = {"mode": RestoreOptions.mode, "precision": RestoreOptions.precision}
    now = [str(method.identity.get(key) or value) for key, value in usual.items()]
    then = [str(method.scope.domain.measured.get(key) or value) for key, value in usual.items()]
    if now == then:
        return None
    return (
        f"{method.name} was measured in {' and '.join(then)}, and runs in {' and '.join(now)}: nothing tells how well"
    )


def measured_at(method: Restorer, codes: Codes) -> str | None:
    """Return the measurement that is nearest to a stream, as a line; None where there is none.

    Of a mosaic it is that of every colour.
    """
    if method.scope is None or method.scope.domain is None:
        return None
    places = [place_of(part.sensor, part.exposure, light_of(part)) for part in by_colour(codes)]
    cells = [cell for place in places if (cell := method.scope.domain.nearest(place)) is not None]
    told = dict.fromkeys(f"{cell.name}: {cell.scores}" for cell in cells)
    return f"{method.name} was measured at {'; '.join(told)}" if told else None


def refuse_outside(methods: Sequence[Restorer], found: Sequence[str], option: str, *, named: bool = True) -> None:
    """Raise `ValueError` for `strict`, the name of whose option is given: with the first remark, or without a network.

    Methods that were not `named` are the choice of `auto`: a classical one is no mistake.
    """
    if named and not any(method.learned for method in methods):
        names = ", ".join(method.name for method in methods)
        raise ValueError(f"{option}: acts on networks, and {names} is classical; leave it out")
    if found:
        raise ValueError(f"{found[0]}; leave out {option} to run it nevertheless")
