"""Finds restorers by name, and runs classical methods in blocks of frames that fit the memory.

    codes [T, H, W] -> restored photons [T, H, W], float32

Restorers restore every frame. They pad edges themselves: time by reflection or not at all, space by repetition up to
the multiple that a network needs. Where a frame exceeds the memory bound, less of it is computed at a time (pieces.py).
No ground truth is needed. `restorer(NAME)` finds a classical method, shipped weights, a weights file or a training
folder.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from qsim import plugins
from qsim.checks import suggest
from qsim.files import Progress
from quiver.baselines import METHODS, exposures
from quiver.baselines.methods import Method
from quiver.baselines.sliding_window import look_ahead
from quiver.data.codes import Codes, Sensor
from quiver.device import device_of_process, is_gpu, pick_device
from quiver.model.names import NETWORKS
from quiver.restoration.interface import AUTO, RestoreInto, RestoreOptions, Restorer
from quiver.restoration.networks import network_restorer

if TYPE_CHECKING:
    import torch

PRETRAINED = Path(__file__).parents[1] / "pretrained"  # weights that ship with the package
FRAME_BYTES = 16  # per pixel and frame that a classical method holds: codes and video
OWN_BYTES = 600  # per pixel that a method of others is taken to hold beside codes and video
BLOCK_FRAMES = 32  # at most, of a classical method between two reports of progress


def restorer(name: str, options: RestoreOptions | None = None) -> Restorer:
    """Return a method by name: classical, shipped weights, weights file or training folder.

    A method of others is named by its file, as in `mine.py:restore`, or by an entry point of `quiver.methods`. A
    classical method may be followed by its window in frames, as in `moment:5`. `ValueError` or `FileNotFoundError` for
    another name.
    """
    options = options or RestoreOptions()
    if _is_of_others(name):
        base = _plugin_name(name)
        return _of_others(base, name.removeprefix(base).removeprefix(":"), options)
    base, _, window = name.partition(":")
    if base not in METHODS:
        network = network_restorer(weights_path(name), options)
        return replace(network, fill=partial(_fill_equal_exposures, network.fill, name))
    return _classical(name, METHODS[base], window, options)


def is_classical(name: str) -> bool:
    """Return whether a name is that of a classical method, or of a method of others, and not of a network."""
    return name.partition(":")[0] in METHODS or _is_of_others(name)


def runs_on_any_device(name: str) -> bool:
    """Return whether the device of a method can be chosen: a method of others computes where it will."""
    return not _is_of_others(name)


def _is_of_others(name: str) -> bool:
    base = _plugin_name(name)
    return plugins.file_of(base) is not None or base in plugins.installed(plugins.METHODS)


def _plugin_name(name: str) -> str:
    """Return a name like `mine.py:restore:5`, or one of an entry point, without its window."""
    base, _, window = name.rpartition(":")
    return base if window.isdecimal() else name


def _of_others(base: str, window: str, options: RestoreOptions) -> Restorer:
    """Return a method of others: a function with the signature of the classical ones (baselines/methods.py)."""
    plugin = plugins.load(base, plugins.METHODS)
    assert plugin is not None
    if not callable(plugin.made):
        raise ValueError(f"{base}: is no function; name one that takes codes, sensor and exposure")
    parameters = inspect.signature(plugin.made).parameters
    if lacking := [key for key in ("window", "frames") if key not in parameters]:
        raise ValueError(
            f"{base}: its arguments are (codes, sensor, exposure, *, window=11, photons_per_unit=1.0, frames=None); "
            f"{' and '.join(lacking)} is missing"
        )
    default = parameters["window"].default
    about = next(iter((plugin.made.__doc__ or "").strip().splitlines()), "a method of others")
    method = OwnMethod(base, "", default if isinstance(default, int) else 11, OWN_BYTES, about, plugin.made)
    made = _classical(f"{base}:{window}" if window else base, method, window, options)
    short = f"{Path(base).stem}-{base.rpartition(':')[2]}" if plugins.file_of(base) else base
    return replace(
        made,
        name=f"{short}:{window}" if window else short,
        any_device=False,
        identity={**made.identity, "method": short, **asdict(plugin.source)},
    )


@dataclass(frozen=True)
class OwnMethod(Method):
    """A method of others: a function in place of the name of one."""

    function: Callable[..., Array] | None = None

    def restore(self, *given: Any, **settings: Any) -> Array:
        """Restore codes; `ValueError` for an answer of another shape or type."""
        assert self.function is not None
        restored = np.asarray(self.function(*given, **settings), np.float32)
        codes = given[0]
        expected = (len(settings["frames"]) if settings.get("frames") is not None else len(codes), *codes.shape[1:])
        if restored.shape != expected:
            raise ValueError(f"{self.name}: returned {list(restored.shape)}, expected {list(expected)}")
        return restored


def _classical(name: str, method: Method, window: str, options: RestoreOptions) -> Restorer:
    """Return a classical method with its own window or another one."""
    base = method.name
    if window and not (window.isdecimal() and int(window) > 0):
        raise ValueError(f"method {name!r}: the window after the colon is a number of frames, as in {base}:5")
    frames = int(window) if window else method.window
    kind = Restorer.device if isinstance(method, OwnMethod) else pick_device(options.device)
    run = partial(method.restore, window=frames) if window else method.restore

    def fill(codes: Codes, out: Array, first: int, progress: Progress | None) -> None:
        device = device_of_process(kind)
        if is_gpu(device) and codes.shares is None:
            memory = options.bound()
            there = partial(_restore_there, base, frames, device, memory)
            fill_classical(there, frames, codes, out, first, memory, progress)
            return
        if is_gpu(device):
            problem = f"{name} restores codes whose exposures take turns on a CPU"
            if options.device != "auto":
                raise ValueError(f"device={options.device}: {problem}; give device=cpu")
            warnings.warn(f"{problem}, though this machine has a GPU", stacklevel=2)
        taken = method.bytes_per_pixel * codes.shape[1] * codes.shape[2]
        memory = options.bound(host=True)
        if taken > memory:
            size = f"{codes.shape[1]} x {codes.shape[2]} px"
            warnings.warn(
                f"{name} takes about {taken / 1e6:.0f} MB for a frame of {size}, above memory={memory}",
                stacklevel=2,
            )
        free = memory - taken
        if codes.shares is None:
            fill_classical(run, frames, codes, out, first, free, progress)
            return
        bracketed = partial(exposures.restore, method=base, window=frames)
        fill_classical(bracketed, frames, codes, out, first, free, progress)

    identity = {"method": base, "window": frames}
    return Restorer(name, frames, look_ahead(frames), False, method.description, fill, identity=identity, device=kind)


def _restore_there(
    name: str,
    window: int,
    device: torch.device,
    memory: int,
    codes: Array,
    sensor: Sensor,
    exposure: float,
    *,
    frames: range,
) -> Array:
    """Restore codes by a classical method on a device."""
    from quiver.baselines.batched import methods

    return methods.restore(
        codes, sensor, exposure, method=name, device=device, window=window, memory=memory, frames=frames
    )


def _fill_equal_exposures(
    fill: RestoreInto, name: str, codes: Codes, out: Array, first: int, progress: Progress | None
) -> None:
    """Run a network on codes of equal exposure; `ValueError` for others."""
    if codes.shares is not None:
        known = ", ".join(exposures.METHODS)
        raise ValueError(f"method {name!r}: takes equal exposures only; use {known} for {codes.name}")
    fill(codes, out, first, progress)


def shipped_names() -> list[str]:
    """Return the networks whose weights come with the package."""
    return sorted(file.stem for file in PRETRAINED.glob("*.safetensors"))


def method_names() -> list[str]:
    """Return every method that needs no training: the classical ones and the shipped networks."""
    return [*METHODS, *plugins.installed(plugins.METHODS), *shipped_names()]


def restorers(names: Sequence[str], options: RestoreOptions | None = None) -> list[Restorer]:
    """Return several methods for one table; `all` expands to every method that needs no training.

    `ValueError` as for `restorer`, and where two methods would have one name.
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
    """Return the weights file of a shipped preset, a file or a training folder."""
    path = Path(name)
    shipped = shipped_names()
    if name in shipped:
        return PRETRAINED / f"{name}.safetensors"
    if path.suffix == ".safetensors":
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such weights file")
        return path
    if (path / "best.safetensors").is_file():
        return path / "best.safetensors"
    if (path / "settings.json").is_file():
        raise FileNotFoundError(f"{path}: a training run without best.safetensors; continue it until it has validated")
    if name.partition(":")[0] == AUTO:
        raise ValueError(
            f"{name}: `auto` chooses the method of one stream, for `quiver restore`, and has no window; name one of "
            f"{', '.join(method_names())}"
        )
    if name in METHODS:
        own = ", ".join(shipped)
        raise ValueError(
            f"{name}: a classical method has no weights; name {own}, a .safetensors file or a folder of `quiver train`"
        )
    if name in NETWORKS:
        raise ValueError(
            f"{name}: a network without shipped weights; train it (`quiver train`), and name the folder of the run"
        )
    raise ValueError(
        f"no method {name!r}{suggest(name, (*method_names(), *NETWORKS))}; known are {', '.join(method_names())}, a "
        "Python file (mine.py:restore), a .safetensors file, a folder of `quiver train`, and in `quiver bench` its "
        "presets"
    )


def fill_classical(
    restore: Callable[..., Array],
    window: int,
    codes: Codes,
    out: Array,
    first: int,
    free: int,
    progress: Progress | None,
) -> None:
    """Run a classical method on blocks of frames that `free` bytes hold, together with the frames around them.

    Frames are not cut: the memory changes no answer.
    """
    length, height, width = codes.shape
    last = first + len(out)
    block = min(BLOCK_FRAMES, max(1, free // (FRAME_BYTES * height * width)))
    for start in range(first, last, block):
        stop = min(start + block, last)
        before = max(0, start - window)
        after = min(length, stop + window)
        wanted = range(start - before, stop - before)
        read = codes.read(before, after)
        taken = [] if codes.shares is None else [np.resize(codes.shares, after)[before:]]
        out[start - first : stop - first] = restore(read, codes.sensor, codes.exposure, *taken, frames=wanted)
        if progress is not None:
            progress(stop - first, len(out))
