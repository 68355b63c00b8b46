"""Restores streams by MergeNet: merges frames along their paths, corrects them by the network, returns to photons.

    codes -> path_merge.stream -> merge_inputs -> MergeNet -> phi + deviation x correction -> photons

The stated delay is half a window: five frames; the first frames wait for a complete window. A frame is read, pooled
and merged in one pass, tile by tile where the memory does not hold it; tiles are blended, since paths reach far. On a
GPU many frames are restored at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from qsim.files import Progress
from quiver.data.codes import Codes, frame_reader
from quiver.device import is_gpu
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.pieces import Disagreement, Pieces, cut_pieces, told_of_cut

if TYPE_CHECKING:
    import torch

MOST = 16  # frames that are restored at a time


def fill_merged(
    network: Any, codes: Codes, out: Array, first: int, options: RestoreOptions, progress: Progress | None
) -> str | None:
    """Restore tile by tile and frame by frame; `out` [t, H, W] must be zero and collects the weighted tiles.

    Where a cut changes the answer (pieces.py), the line returned states by how much neighbouring tiles differ.
    """
    from quiver.baselines.domain_tables import domain_tables
    from quiver.baselines.information_domain import information_domain
    from quiver.baselines.path_merge import stream
    from quiver.model.blocks import WINDOW

    length, height, width = codes.shape
    device = next(network.parameters()).device
    domain = information_domain(codes.sensor, codes.exposure)
    tables = domain_tables(domain, device)
    pieces = cut_pieces(network, height, width, options.bound())
    together = frames_together(pieces, device, options.bound())
    apart = Disagreement.nothing(height, width)
    done = 0
    read = frame_reader(codes)
    for tile in pieces.tiles:
        rows, columns = tile.weight.shape
        part = (slice(tile.y, tile.y + rows), slice(tile.x, tile.x + columns))

        def frame(t: int, part: tuple[slice, slice] = part) -> Array:
            return read(t)[part]

        wanted = range(first, first + len(out))
        t = 0
        for merged in stream(frame, length, domain, WINDOW, wanted, device, together=together):
            restored = corrected(network, merged, tables, options)[:, :rows, :columns]
            out[(slice(t, t + len(restored)), *part)] += tile.weight * restored
            # One frame tells how much tiles differ, as all have the same cut.
            if t == 0 and not pieces.exact:
                apart.add(tile, restored[0] / np.float32(codes.white))
            t += len(restored)
            done += len(restored)
            if progress is not None:
                progress(done, len(out) * len(pieces.tiles))
    return told_of_cut(codes, pieces, apart)


def corrected(network: Any, merged: Any, tables: Any, options: RestoreOptions) -> Array:
    """Return photons, float32 [B, H, W], of merged frames [B, H, W] after the network's correction."""
    import torch

    from quiver.restoration.merge_inputs import merge_inputs

    inputs = merge_inputs(merged, tables)
    device = inputs.phi.device
    low = options.precision == "bfloat16"
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=low):
        correction = network(inputs.channels)[:, 0].float()
    restored: Array = tables.photons(correction * inputs.deviation + inputs.phi).cpu().numpy()
    return restored


def frames_together(pieces: Pieces, device: torch.device, memory: int) -> int:
    """Return how many frames are restored at a time: on a GPU as many as the memory holds, up to MOST, elsewhere one.

    A frame alone leaves the caches of a CPU less often.
    """
    from quiver.baselines.path_merge import PIXEL_BYTES

    if not is_gpu(device):
        return 1
    largest = max(tile.weight.size for tile in pieces.tiles)
    return min(MOST, max(1, memory // (PIXEL_BYTES * largest)))
