"""Restoring streams of any length and size, with any method, in bounded memory.

    codes [T, H, W] -> restored photons [T, H, W], float32

Edges are padded inside: time by reflection, so that every frame is restored; space by repetition up to the multiple the
network needs. Where a frame takes more than the memory bound, less of it is computed at a time (pieces.py). No ground
truth is needed. `restorer(NAME)` finds a classical method, shipped weights, a weights file or a training folder.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray as Array

from qsim.checks import suggest
from quiver.baselines import METHODS
from quiver.baselines.sliding_window import look_ahead, reflect
from quiver.data.codes import Codes
from quiver.restoration.pieces import Disagreement, cut_pieces

if TYPE_CHECKING:
    from torch import Tensor, nn

    from quiver.restoration.domain import Scope

PRETRAINED = Path(__file__).parents[1] / "pretrained"  # weights that ship with the package
DEFAULT_MEMORY = 2_000_000_000  # bytes; of working memory beside the weights
FRAME_BYTES = 16  # per pixel and frame that a classical method holds: codes and video
BLOCK_FRAMES = 32  # that a classical method restores between two reports of progress, at most
BLOCK_PIXELS = 1 << 22  # codes read at a time: 4 MB
CONTEXT = 5  # frames that a network needs before and after the one it restores
MODES = ("exact", "streaming", "windows")  # how a network shares work between frames, see quiver/model/schedules.py

Progress = Callable[[int, int], None]  # (steps done, steps in all)
Fill = Callable[[Codes, Array, int, Progress | None], None]  # adds photons of frames `first` ... to zeros [t, H, W]


@dataclass(frozen=True)
class Options:
    """How to run, not what to compute: apart from `mode` and `precision` the numbers agree to rounding.

    A memory that holds no whole frame of a QUIVER network is the exception: a warning then says what it changed.
    """

    memory: int = DEFAULT_MEMORY  # bytes
    mode: str = "exact"  # exact = the published windows; streaming = state carried on, faster; windows = recomputed
    device: str = "auto"  # auto, cpu, cuda
    precision: str = "float32"  # or bfloat16

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(f"mode {self.mode!r}; known are {', '.join(MODES)}")
        if self.precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision {self.precision!r}; known are float32 and bfloat16")
        if self.memory < 1:
            raise ValueError(f"memory is a number of bytes above 0, got {self.memory}")


@dataclass(frozen=True)
class Restorer:
    """A method ready to run, and what a table says about it."""

    name: str
    window: int  # frames used for one restored frame
    look_ahead: int  # of these, future ones
    learned: bool
    description: str
    fill: Fill
    seamless: bool = True  # a range of frames restored alone equals that part of the whole
    identity: Mapping[str, object] = field(default_factory=dict)  # settings and weights that change the answer
    cut: Callable[[int, int], str] = lambda height, width: ""  # of a frame, where it changes the answer
    scope: Scope | None = None  # of a network: what it was measured for or trained on; None: not known

    def restore(self, codes: Codes, first: int = 0, last: int | None = None, progress: Progress | None = None) -> Array:
        """Restored photons float32 [last - first, H, W] of frames first ... last - 1, all of them by default."""
        length, height, width = codes.shape
        out = np.zeros(((length if last is None else last) - first, height, width), np.float32)
        self.fill(codes, out, first, progress)
        return out


def restorer(name: str, options: Options | None = None) -> Restorer:
    """A method by name, shipped preset, weights file or training folder; ValueError or FileNotFoundError otherwise.

    A classical method may be followed by its window in frames, as in `moment:5`.
    """
    options = options or Options()
    base, _, window = name.partition(":")
    if base not in METHODS:
        return network_restorer(weights_path(name), options)
    method = METHODS[base]
    if window and not (window.isdecimal() and int(window) > 0):
        raise ValueError(f"method {name!r}: the window after the colon is a number of frames, as in {base}:5")
    frames = int(window) if window else method.window
    run = partial(method.restore, window=frames) if window else method.restore

    def fill(codes: Codes, out: Array, first: int, progress: Progress | None) -> None:
        taken = method.bytes_per_pixel * codes.shape[1] * codes.shape[2]
        if taken > options.memory:
            size = f"{codes.shape[1]} x {codes.shape[2]} px"
            warnings.warn(
                f"{name} takes about {taken / 1e6:.0f} MB for a frame of {size}, above --memory", stacklevel=2
            )
        fill_classical(run, frames, codes, out, first, options.memory - taken, progress)

    identity = {"method": base, "window": frames}
    return Restorer(name, frames, look_ahead(frames), False, method.description, fill, identity=identity)


def shipped_names() -> list[str]:
    """Networks whose weights come with the package."""
    return sorted(file.stem for file in PRETRAINED.glob("*.safetensors"))


def method_names() -> list[str]:
    """Every method that needs no training: the classical ones and the shipped networks."""
    return [*METHODS, *shipped_names()]


def restorers(names: Sequence[str], options: Options | None = None) -> list[Restorer]:
    """Several methods for one table; `all` stands for every method that needs no training.

    ValueError as for `restorer`, and where two of them would go by one name.
    """
    expanded = [one for name in names for one in (method_names() if name == "all" else (name,))]
    found: dict[str, str] = {}
    methods = []
    for name in dict.fromkeys(expanded):
        method = restorer(name, options)
        if method.name in found:
            raise ValueError(
                f"methods {found[method.name]!r} and {name!r} are both called {method.name!r}; rename the folder of one"
            )
        found[method.name] = name
        methods.append(method)
    return methods


def weights_path(name: str) -> Path:
    """The weights file meant by the name of a shipped preset, a file or a training folder."""
    path, shipped = Path(name), shipped_names()
    if name in shipped:
        return PRETRAINED / f"{name}.safetensors"
    if path.suffix == ".safetensors":
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such weights file")
        return path
    if (path / "best.safetensors").is_file():
        return path / "best.safetensors"
    if (path / "settings.json").is_file():
        raise FileNotFoundError(f"{path}: a training run without best.safetensors; has it validated yet?")
    raise ValueError(
        f"no method {name!r}{suggest(name, method_names())}; known are {', '.join(method_names())}, a "
        ".safetensors file, and a folder of `quiver train`"
    )


def network_restorer(path: Path, options: Options) -> Restorer:
    """The network stored in a weights file; a training run is named after its folder."""
    from quiver.model.weights import load, metadata_of
    from quiver.restoration.domain import read_scope

    model = load(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    name = path.parent.name if path.name == "best.safetensors" else path.stem
    description = f"{network_title(model)}, weights {digest[:12]}, {options.mode}"
    method = wrap_network(model, name, description, options, weights_sha256=digest)
    return replace(method, scope=read_scope(path, metadata_of(path)))


def network_title(model: nn.Module) -> str:
    """What a network is, for people: `nano (U-Net on aligned frames)`, `QUIVER (quiver-s)`, `U-Net`."""
    from quiver.model.presets import PRESETS
    from quiver.model.quiver import QUIVER

    if not isinstance(model, QUIVER):
        return "U-Net"
    preset = next((name for name, config in PRESETS.items() if config == model.config), None)
    if model.config.baseline:  # its picture is that of the hourglass; the recurrent part hardly adds to it
        what = "U-Net on aligned frames" if model.config.sweep else "U-Net with a recurrent part"
        return what if preset is None else f"{preset} ({what})"
    return "QUIVER" if preset is None else f"QUIVER ({preset})"


def wrap_network(
    model: nn.Module, name: str, description: str, options: Options, weights_sha256: str | None = None
) -> Restorer:
    """A network as a method; the checksum is that of its weights file."""
    from quiver.model.blocks import RADIUS, WINDOW
    from quiver.model.quiver import QUIVER

    mode = options.mode if isinstance(model, QUIVER) else "windows"  # others share no work between frames
    model.to(pick_device(options.device)).eval()

    def fill(codes: Codes, out: Array, first: int, progress: Progress | None) -> None:
        fill_network(model, codes, out, first, options, progress)

    identity = {"weights_sha256": weights_sha256, "mode": mode, "precision": options.precision}

    def cut(height: int, width: int) -> str:
        return cut_pieces(model, height, width, options.memory, options.mode).text

    return Restorer(name, WINDOW, RADIUS, True, description, fill, mode != "streaming", identity, cut)


def pick_device(wanted: str) -> str:
    """`auto` is CUDA where there is one."""
    import torch

    if wanted == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch finds no CUDA device here; use --device cpu")
    return wanted


def fill_classical(
    restore: Callable[..., Array],
    window: int,
    codes: Codes,
    out: Array,
    first: int,
    free: int,
    progress: Progress | None,
) -> None:
    """Run a classical method over blocks of frames that `free` bytes hold, with the frames around them that it needs.

    Frames are taken whole: what memory there is changes no answer.
    """
    length, height, width = codes.shape
    last = first + len(out)
    block = min(BLOCK_FRAMES, max(1, free // (FRAME_BYTES * height * width)))
    for start in range(first, last, block):
        stop = min(start + block, last)
        before, after = max(0, start - window), min(length, stop + window)
        wanted = range(start - before, stop - before)
        read = codes.read(before, after)
        out[start - first : stop - first] = restore(read, codes.sensor, codes.exposure, frames=wanted)
        if progress is not None:
            progress(stop - first, len(out))


def fill_network(
    model: nn.Module, codes: Codes, out: Array, first: int, options: Options, progress: Progress | None
) -> None:
    """Restore tile by tile, frame by frame; `out` must be zero and collects the weighted tiles.

    A warning says by how much tiles differ where a frame is cut in a way that changes the answer (see pieces.py).
    """
    import torch

    from quiver.model.quiver import QUIVER

    device = next(model.parameters()).device
    dtype = torch.bfloat16 if options.precision == "bfloat16" else torch.float32
    height, width = codes.shape[1:]
    pieces = cut_pieces(model, height, width, options.memory, options.mode)
    if isinstance(model, QUIVER) and model.baseline is not None:
        model.baseline.pixels = pieces.hourglass
    multiple = int(model.multiple)  # type: ignore[arg-type]
    apart, done = Disagreement.nothing(height, width), 0
    for tile in pieces.tiles:
        rows, columns = tile.weight.shape
        part = (slice(tile.y, tile.y + rows), slice(tile.x, tile.x + columns))
        frames = (pad_space(frame, multiple).to(device) for frame in padded_frames(codes, part, first, len(out)))
        with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            for t, picture in enumerate(pictures(model, frames, options.mode)):
                restored = picture[0, 0, :rows, :columns].float().cpu().numpy()
                out[(t, *part)] += tile.weight * restored * np.float32(codes.white)
                if t == 0 and not pieces.exact:
                    apart.add(tile, restored)
                done += 1
                if progress is not None:
                    progress(done, len(out) * len(pieces.tiles))
    if not pieces.exact:  # tiles that agree may still differ from the whole frame
        rms, most = apart.measured()
        more = f"; --memory {-(-pieces.needed // 10**6)}MB restores it whole" if pieces.needed else ""
        warnings.warn(
            f"{codes.name}: {options.memory / 1e6:.0f} MB hold no frame of {height} x {width} px; cut into "
            f"{pieces.text}, which differ where they overlap by {100 * rms:.2g} % of white rms, {100 * most:.2g} % at "
            f"most{more}",
            stacklevel=2,
        )


def padded_frames(codes: Codes, part: tuple[slice, slice], first: int, count: int) -> Iterator[Tensor]:
    """Frames first-5 ... first+count+4 (reflected at the ends of the stream) as networks see them, [1, 1, h, w]."""
    import torch

    length, height, width = codes.shape
    top = codes.sensor.levels - 1
    step = max(1, BLOCK_PIXELS // (height * width))  # reading, and drawing, is quicker by the block

    @lru_cache(maxsize=2)
    def block(i: int) -> Array:
        return codes.read(i * step, min((i + 1) * step, length))

    for t in reflect(np.arange(first - CONTEXT, first + count + CONTEXT), length):
        frame = block(int(t) // step)[(int(t) % step, *part)].astype(np.float32) / np.float32(top)
        yield torch.from_numpy(frame)[None, None]


def pad_space(frame: Tensor, multiple: int) -> Tensor:
    """[1, 1, h, w] continued to the right and down by its last pixels, up to multiples of `multiple`."""
    import torch.nn.functional as functional

    height, width = frame.shape[-2:]
    return functional.pad(frame, (0, -width % multiple, 0, -height % multiple), mode="replicate")


def pictures(model: nn.Module, frames: Iterable[Tensor], mode: str) -> Iterator[Tensor]:
    """Restored frames [1, 1, h, w], one for each frame that has five before and five after it."""
    from quiver.model import schedules
    from quiver.model.quiver import QUIVER

    if isinstance(model, QUIVER) and mode != "windows":
        yield from (schedules.exact if mode == "exact" else schedules.stream)(model, frames)
    else:
        yield from schedules.windows(model, frames)


def check_finite(restored: Array, name: str, first: int = 0) -> None:
    """ValueError naming the first frame with a value that is not finite; `first` is the number of the first one."""
    for t, frame in enumerate(restored, start=first):
        if not np.isfinite(frame).all():
            raise ValueError(f"{name}: restored frame {t} holds NaN or Inf; are the weights damaged?")
