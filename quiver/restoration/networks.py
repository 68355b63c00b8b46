"""Runs networks as restorers, tile by tile where a frame exceeds the memory bound (pieces.py)."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from qsim.files import Progress
from quiver.baselines.sliding_window import reflect
from quiver.data.clips import peak_of
from quiver.data.codes import Codes, frame_reader, light_of
from quiver.data.noise_table import noise_table
from quiver.device import moved, pick_device
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.learned_bands import LearnedBands
from quiver.restoration.pieces import Disagreement, cut_pieces, part_of, takes_clips, told_of_cut

if TYPE_CHECKING:
    from torch import Tensor, nn

# Restores into zeros, and returns a line on a cut that changes the answer; called with
# (network, codes, zeros, first, options, progress)
RestoreNetwork = Callable[[Any, Codes, Array, int, RestoreOptions, Progress | None], str | None]
EXCESS = 10.0  # times white, or the peak of scores where that is brighter: restored light lies near 0 ... 1
CONTEXT = 5  # frames that a network needs before and after the one it restores


def network_restorer(path: Path, options: RestoreOptions) -> Restorer:
    """Return the network of a weights file; a training run is named after its folder."""
    from quiver.model.weights import digest, load, metadata_of
    from quiver.restoration.domain import read_scope

    model = load(path)
    name = Path(os.path.abspath(path)).parent.name if path.name == "best.safetensors" else path.stem

    known = digest(path)
    description = f"{network_title(model)}, weights {known[:12]}"
    restorer = wrap_network(model, name, description, options, weights_sha256=known)
    return replace(restorer, scope=read_scope(path, metadata_of(path)))


def network_title(model: nn.Module) -> str:
    """Return a title for people: `QUIVER (quiver-s)`, `U-Net`, `EMVD (emvd)`."""
    from quiver.model.mosaic_network import MosaicNet
    from quiver.model.presets import PRESETS
    from quiver.model.unet import UNet

    if isinstance(model, MosaicNet):
        return f"{network_title(model.core)} on mosaics of {' '.join(model.config.mask)}"
    if isinstance(model, UNet):
        return "U-Net"
    preset = next((name for name, config in PRESETS.items() if config == model.config), None)
    return type(model).__name__ if preset is None else f"{type(model).__name__} ({preset})"


def wrap_network(
    model: nn.Module, name: str, description: str, options: RestoreOptions, weights_sha256: str | None = None
) -> Restorer:
    """Return a network as a method; the checksum is that of its weights."""
    from quiver.model.blocks import RADIUS, WINDOW
    from quiver.model.mergenet import MergeNet
    from quiver.model.mosaic_network import MosaicNet
    from quiver.model.quiver import QUIVER
    from quiver.model.schedules import REACH
    from quiver.restoration.merging import fill_merged

    if isinstance(model, MosaicNet):
        core = wrap_network(model.core, name, description, options, weights_sha256)
        model.to(core.device).eval()
        return replace(core, bands=LearnedBands(name, model))

    mode = options.mode if isinstance(model, QUIVER) else None  # other networks have one way to share work
    description = description if mode is None else f"{description}, {mode}"
    device = pick_device(options.device)
    model.to(device).eval()
    run: RestoreNetwork = fill_network
    window = WINDOW
    look_ahead = RADIUS
    together = 1
    seen = None
    if mode == "streaming":  # features reach further, and the state back to the first frame
        window = WINDOW + REACH
        look_ahead = RADIUS + REACH
    if isinstance(model, MergeNet):
        run = fill_merged
    elif takes_clips(model):
        part = part_of(model)
        run = fill_parts
        window = part.past + 1 + part.future
        look_ahead = part.future
        together = part.kept
        description = f"{description}; look-ahead {look_ahead} frames"
        seen = min(window, part.seen)

    told: set[tuple[str, str]] = set()  # what, and of which source: blocks, windows and places of a mask are told once

    def fill(codes: Codes, out: Array, first: int, progress: Progress | None) -> None:
        found = {"cut": run(model, codes, out, first, options, progress)}
        if run is not fill_merged and ("excess", codes.source) not in told:
            found["excess"] = excess(codes, out, first)
        for what, text in found.items():
            if text is not None and (what, codes.source) not in told:
                told.add((what, codes.source))
                warnings.warn(text, stacklevel=2)

    identity = {"weights_sha256": weights_sha256, "mode": mode, "precision": options.precision}

    def cut(height: int, width: int) -> str:
        return cut_pieces(model, height, width, options.bound()).text

    return Restorer(
        name,
        window,
        look_ahead,
        True,
        description,
        fill,
        mode != "streaming",
        identity,
        cut,
        together,
        device=device,
        seen=seen,
    )


def excess(codes: Codes, out: Array, first: int) -> str | None:
    """Return a line on restored light [t, H, W] far above all light of its stream: a recurrent state grew, or the
    weights are bad. None otherwise. Frames that are not finite are an error elsewhere.
    """
    most = np.array([max(float(frame.max()), -float(frame.min())) for frame in out])  # a copy of `out` may not fit
    most[~np.isfinite(most)] = 0
    if not most.size or most.max() <= EXCESS * codes.white:
        return None
    unit = max(codes.white, peak_of(light_of(codes)))  # of a binary SPAD the mean may exceed white
    beyond = np.flatnonzero(most > EXCESS * unit)
    if not beyond.size:
        return None
    return (
        f"{codes.name}: the restored light reaches {most.max() / unit:.2g} times the brightest of such a stream, above "
        f"{EXCESS:g} times first in frame {first + beyond[0]}: this network is not stable here; train it longer, or on "
        "longer windows"
    )


def settings_of(method: Restorer, codes: Codes) -> tuple[str, str]:
    """Return the precision, and the tiles of a frame where they change the answer, else an empty text."""
    rows, columns = codes.tile  # each place of a mask is a frame
    try:
        cut = method.cut(-(-codes.shape[1] // rows), -(-codes.shape[2] // columns))
    except ValueError:
        cut = "no tile fits"  # restoring states the reason
    return str(method.identity.get("precision", RestoreOptions.precision)), cut


def fill_network(
    model: nn.Module, codes: Codes, out: Array, first: int, options: RestoreOptions, progress: Progress | None
) -> str | None:
    """Restore tile by tile and frame by frame; `out` [t, H, W] must be zero and collects the weighted tiles.

    Where a cut changes the answer (pieces.py), the line returned states by how much neighbouring tiles differ.
    """
    import torch

    device = next(model.parameters()).device
    dtype = torch.bfloat16 if options.precision == "bfloat16" else torch.float32
    height, width = codes.shape[1:]
    pieces = cut_pieces(model, height, width, options.bound())
    multiple = int(model.multiple)  # type: ignore[arg-type]
    apart = Disagreement.nothing(height, width)
    done = 0
    for tile in pieces.tiles:
        rows, columns = tile.weight.shape
        part = (slice(tile.y, tile.y + rows), slice(tile.x, tile.x + columns))
        frames = (moved(pad_space(frame, multiple), device) for frame in padded_frames(codes, part, first, len(out)))
        with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            for t, picture in enumerate(pictures(model, frames, options.mode)):
                restored = picture[0, 0, :rows, :columns].float().cpu().numpy()
                out[(t, *part)] += tile.weight * restored * np.float32(codes.white)
                if t == 0 and not pieces.exact:
                    apart.add(tile, restored)
                done += 1
                if progress is not None:
                    progress(done, len(out) * len(pieces.tiles))
    return told_of_cut(codes, pieces, apart)


def fill_parts(
    network: nn.Module, codes: Codes, out: Array, first: int, options: RestoreOptions, progress: Progress | None
) -> str | None:
    """Restore part after part, each tile by tile; `out` [t, H, W] must be zero and collects the weighted tiles.

    Where a cut in space changes the answer (pieces.py), the line returned states by how much neighbouring tiles differ.
    """
    import torch

    device = next(network.parameters()).device
    dtype = torch.bfloat16 if options.precision == "bfloat16" else torch.float32
    length, height, width = codes.shape
    part = part_of(network)
    last = first + len(out)
    done = 0
    top = np.float32(codes.sensor.levels - 1)
    pieces = cut_pieces(network, height, width, options.bound())
    apart = Disagreement.nothing(height, width)
    known = known_of(network, codes)
    for start in range(first - first % part.kept, last, part.kept):
        end = min(length, start + part.kept + part.after)
        begin = max(0, min(start - part.before, end - 1 - part.after))  # the last frames are reflected at the end
        wanted = slice(max(start, first), min(start + part.kept, last))
        frames = codes.read(begin, end)
        for tile in pieces.tiles:
            rows, columns = tile.weight.shape
            place = (slice(tile.y, tile.y + rows), slice(tile.x, tile.x + columns))
            cut = frames[(slice(None), *place)].astype(np.float32) / top  # of a tile, not of all frames
            seen = torch.from_numpy(cut)[None, :, None].to(device)
            with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
                result = restored_frames(network, seen, wanted.start - begin, wanted.stop - begin, **known)[0, :, 0]
            restored = result.float().cpu().numpy()
            out[(slice(wanted.start - first, wanted.stop - first), *place)] += (
                tile.weight * restored * np.float32(codes.white)
            )
            if wanted.start == first and not pieces.exact:
                apart.add(tile, restored[0])
            done += len(restored)
            if progress is not None:
                progress(done, len(out) * len(pieces.tiles))
    return told_of_cut(codes, pieces, apart)


def restored_frames(network: Any, frames: Tensor, first: int, last: int, **known: Tensor) -> Tensor:
    """Clip [1, T, 1, h, w] -> restored frames first ... last - 1; networks of windows compute these alone."""
    from quiver.model.rivals.edges import restored_range

    if hasattr(network, "windows"):
        return restored_range(network, frames, first, last, **known)
    restored: Tensor = network(frames, **known)
    return restored[:, first:last]


def known_of(network: Any, codes: Codes) -> dict[str, Tensor]:
    """Return the inputs of a network beside the frames: the noise table of the stream's sensor, if it takes one.

    `ValueError` for a sensor whose mean code does not rise with light.
    """
    import torch

    if not getattr(network, "takes_variance", False):
        return {}
    return {"variance": torch.tensor(noise_table(codes.sensor, codes.exposure))}


def padded_frames(codes: Codes, part: tuple[slice, slice], first: int, count: int) -> Iterator[Tensor]:
    """Yield frames first-5 ... first+count+4 as input of networks, [1, 1, h, w], codes / (2^b - 1).

    Frames beyond the ends of the stream are reflections.
    """
    import torch

    length = codes.shape[0]
    top = codes.sensor.levels - 1
    read = frame_reader(codes)
    for t in reflect(np.arange(first - CONTEXT, first + count + CONTEXT), length):
        yield torch.from_numpy(read(int(t))[part].astype(np.float32) / np.float32(top))[None, None]


def pad_space(frame: Tensor, multiple: int) -> Tensor:
    """Return a frame [1, 1, h, w] padded to the right and below by its last pixels, to multiples of `multiple`."""
    import torch.nn.functional as functional

    height, width = frame.shape[-2:]
    return functional.pad(frame, (0, -width % multiple, 0, -height % multiple), mode="replicate")


def pictures(model: nn.Module, frames: Iterable[Tensor], mode: str) -> Iterator[Tensor]:
    """Yield restored frames [1, 1, h, w]: one for each frame that has five frames before and five after it."""
    from quiver.model import schedules
    from quiver.model.quiver import QUIVER

    if isinstance(model, QUIVER) and mode != "windows":
        yield from (schedules.exact if mode == "exact" else schedules.stream)(model, frames)
    else:
        yield from schedules.windows(model, frames)
