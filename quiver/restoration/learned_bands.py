"""Joins the light of a mosaic's places to R, G and B by the learned end of a MosaicNet, in place of the linear filters.

    light [H, W] behind a mask -> linear estimate [3, H, W] -> MosaicNet.bands -> photons of R, G and B [3, H, W]

The network knows one mask. A stream whose first pixel lies elsewhere in the tile has that mask, too: rows and columns
are put before it, and taken off again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray as Array

from quiver.data.codes import Codes
from quiver.data.mosaic_windows import within

if TYPE_CHECKING:
    from quiver.model.mosaic_network import MosaicNet

ROWS_AT_ONCE = 256  # of tiles, computed together with their surroundings: the memory of large frames


@dataclass(frozen=True)
class LearnedBands:
    """The learned end of one network."""

    name: str  # of the method
    network: MosaicNet

    def check(self, codes: Codes) -> None:
        """Raise `ValueError` for a stream of one band, and for other masks than that of the network."""
        self._place(codes)

    def _place(self, codes: Codes) -> tuple[int, int]:
        """Return row and column of the network's tile at which the first pixel of a stream lies."""
        own = " ".join(self.network.config.mask)
        if codes.colour is None:
            raise ValueError(
                f"{self.name}: was trained on mosaics of the mask {own}, and {codes.name} has one band; name a method "
                "of one band"
            )
        rows, columns = self.network.config.tile
        for y, x in np.ndindex(rows, columns):
            if codes.colour.shifted(-y, -x).mask == self.network.config.mask:
                return y, x
        raise ValueError(
            f"{self.name}: was trained on the mask {own}, and {codes.name} has {' '.join(codes.colour.mask)}; train it "
            "on this mask, or name a method of one band, which restores any"
        )

    def __call__(self, codes: Codes, light: Array) -> Array:
        """Return photons of R, G and B, float32 [3, H, W], of the light [H, W] of one frame."""
        import torch

        rows, columns = self.network.config.tile
        before = self._place(codes)
        height, width = light.shape
        y = within(height, rows, before[0], -(height + before[0]) % rows)
        x = within(width, columns, before[1], -(width + before[1]) % columns)
        device = next(self.network.enter.parameters()).device
        placed = light.astype(np.float32)[y[:, None], x]
        linear = codes.demosaiced(light).astype(np.float32)[:, y[:, None], x]
        mean = torch.tensor([float(light.mean())], device=device)
        reach = self.network.reach * rows
        found = np.empty_like(linear)
        # Strips with the reach of the network around them give what the whole picture would, in less memory.
        for start in range(0, len(y), ROWS_AT_ONCE * rows):
            stop = min(start + ROWS_AT_ONCE * rows, len(y))
            first = max(0, start - reach)
            last = min(len(y), stop + reach)
            part = torch.from_numpy(placed[first:last])[None].to(device)
            guess = torch.from_numpy(linear[:, first:last])[None].to(device)
            with torch.inference_mode():
                bands = self.network.bands(part, guess, mean, mean)[0].cpu().numpy()
            found[:, start:stop] = bands[:, start - first : stop - first]
        return found[:, before[0] : before[0] + height, before[1] : before[1] + width]
