"""Draws whole batches of training windows on a device that holds the light of their clips (device_light.py).

    place of a window (host) -> radiance at its pixels -> photons, in float64 -> codes, targets: all on the device

The windows are those of `Windows`, to the bit: every number is computed by the same operations in the same order. Only
places and keys come from the host, some numbers for each window, and nothing is asked of the device. Of a pool of clips
(`WindowSettings.pool`) the device holds those that a batch may draw, and reads the next ones meanwhile.

Codes are #{k : U >= F_k} of a number U of 64 bits and cubics of F_k. A code differs from that of `draw_codes` with a
chance of about the error of a cubic for each pixel and k: 1e-13.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor
from torch.utils.data import Dataset

from qsim.sensor.defects.defect_table import Defects
from qsim.streams.exposures import Timing
from quiver.data import numpy_sums
from quiver.data.device_filling import FILL, Fills, fill_of
from quiver.data.device_light import CELLS, HeldClips, Unfit, light_of, size_of
from quiver.data.device_words import uniform, words, words_at
from quiver.data.illumination import stored_defects
from quiver.data.mosaic_windows import TURNS, turned_frame
from quiver.data.sensor_of_window import SENSORS, TOP, seen_by, stated
from quiver.data.windows import DARKEST, STAY, Windows
from quiver.device import moved

AHEAD = 2  # clips that are read in advance
SPARE = 4  # slots beside those of a pool: of clips that a batch needs already, and of those that are read


# ---- Places, which the host draws


class Places(Dataset[dict[str, Any]]):
    """Where windows lie, and under which key: what a device needs to draw them. A `torch` data set, as `Windows`.

    An item holds `place`, int64 [10], which `DeviceWindows` reads, `sample` and `key` as of `Windows`. Where some noise
    has defects it also holds how they are filled, and where `seen_by` prepares the windows, what that returns.
    """

    def __init__(self, windows: Windows, slots: int) -> None:
        """Give places of windows whose clips lie in so many slots."""
        self.windows = windows
        self.slots = slots
        self.defects = any(noise.defects is not None for noise in windows.noise.noises)

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, n: int) -> dict[str, Any]:
        windows = self.windows
        place = windows.place(n)
        slot = place.clip if windows.settings.pool is None else windows.position_of(n) % self.slots
        row = slot * len(windows.noise.noises) + place.light
        key = place.key.philox_key
        numbers = (row, place.start, place.y, place.x, *place.drift, place.turn, int(place.backwards))
        place_of_window = torch.tensor((*numbers, key >> 32, key & 0xFFFFFFFF))
        found = {"place": place_of_window, "sample": n, "key": windows.text_of(place)}
        if self.defects:
            bad = windows.bad_of(place)
            none = np.zeros((windows.settings.crop, windows.settings.crop), bool)
            found[FILL] = fill_of(none if bad is None else bad, windows.seen_by(place)[0])
        if windows.prepare is seen_by:
            found |= stated(*windows.seen_by(place))
        return found


# ---- Windows


def why_not(windows: Windows) -> str | None:
    """Return why no device draws these windows; None where one can, as far as settings and noises tell."""
    settings = windows.settings
    if windows.prepare not in (None, seen_by):
        return "the network takes more inputs, which are computed where windows are drawn"
    if settings.still:
        return "they have copies at rest"
    if windows.filters is not None:
        return "they have colour filters"
    for noise in windows.noise.noises:
        if noise.timing != Timing() or noise.sensing.diffraction:
            return f"{noise.label}: has diffraction, or codes of several or late exposures"
        found = Defects() if noise.defects is None else stored_defects(noise.defects)
        if found.disturbed or found.read_out:
            return f"{noise.label}: has crosstalk, afterpulses, or pixels with an offset or read noise of their own"
    return None


class DeviceWindows:
    """Windows whose light lies on a device: batches of places in, batches of `Windows` out."""

    def __init__(self, windows: Windows, device: torch.device, memory: int) -> None:
        """Read all clips onto the device, or make room for a pool of them.

        `Unfit` for windows that it cannot draw, and for more bytes than `memory`.
        """
        problem = why_not(windows)
        if problem is not None:
            raise Unfit(problem)
        self.windows = windows
        self.device = device
        self.shape = (windows.settings.frames, windows.settings.crop, windows.settings.crop)
        sizes = [size_of(clip) for clip in windows.clips]
        pool = windows.settings.pool
        if pool is not None:
            sizes = [max(sizes)] * (pool + SPARE)
        self.places = Places(windows, len(sizes))
        self.held = HeldClips(windows, device, sizes, memory)
        self.positions: dict[int, int] = {}  # of the clips of a pool, by slot
        self.read: dict[int, Future[Tensor]] = {}  # light of clips that come next, by position
        self.reader = ThreadPoolExecutor(max_workers=1)
        if pool is None:
            for slot, clip in enumerate(windows.clips):
                self.held.hold(slot, clip, light_of(clip, device))
        grid: Array = np.indices(self.shape[1:])
        turned: Array = np.stack([turned_frame(grid, turn) for turn in TURNS])
        self.turned = torch.from_numpy(np.ascontiguousarray(turned)).to(device)  # [8, 2, side, side]
        # int64 [8, side side]: the pixel of a turned window for each one of the window that is not turned
        self.places_of_turns = (self.turned[:, 0] * self.shape[2] + self.turned[:, 1]).flatten(1).argsort(dim=1)

    def _turn_over(self, samples: Tensor) -> None:
        """Hold the clips that samples [B] may draw, and read the next ones meanwhile.

        `ValueError` for samples that lie too far apart.
        """
        slots = self.places.slots
        first = int(samples.min()) // STAY
        stop = int(samples.max()) // STAY + slots - SPARE
        if stop - first > slots:
            raise ValueError(f"batch=: more than {SPARE * STAY} windows from first to last; give smaller batches")
        for position in range(first, stop):
            if self.positions.get(position % slots) != position:
                clip = self.windows.clips[self.windows.clip_at(position)]
                read = self.read.pop(position, None)
                light = light_of(clip, self.device) if read is None else read.result()
                self.held.hold(position % slots, clip, light)
                self.positions[position % slots] = position
        self.read = {position: read for position, read in self.read.items() if position >= stop}
        for position in range(stop, first + slots):
            if position not in self.read and len(self.read) < AHEAD:
                clip = self.windows.clips[self.windows.clip_at(position)]
                self.read[position] = self.reader.submit(light_of, clip, self.device)

    def draw(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return the windows of a batch of `places`, with what `Windows` states of them, on the device."""
        if self.windows.settings.pool is not None:
            self._turn_over(batch["sample"])
        fills = Fills.of(batch[FILL], self.device) if FILL in batch else None
        found = self.drawn(moved(batch["place"], self.device), fills)
        return found | {name: batch[name] for name in ("sample", "key", SENSORS, TOP) if name in batch}

    def drawn(self, place: Tensor, fills: Fills | None = None) -> dict[str, Tensor]:
        """Return codes, target, white, peak and ppp of windows at places int64 [B, 10] on the device.

        `fills` are of their defective pixels.
        """
        held = self.held
        row, start, y, x, dy, dx, turn, backwards, high, low = place.unbind(1)
        *light_at, law, steps, array, arrayed, top_of_clip, left_of_clip = held.integers.index_select(0, row).unbind(1)
        first, sharp, frame, width, gain, mapped = light_at
        # float64 [B, 1, 1, 1]
        scale, rate, factor, cells, white, peak, ceiling, wanted = (
            each[:, None, None, None] for each in held.numbers.index_select(0, row).unbind(1)
        )
        frames = self.shape[0]
        order = torch.arange(frames, device=self.device)
        at = order + backwards[:, None] * (frames - 1 - 2 * order)  # [B, T], backwards from the last on
        rows, columns = self.turned.index_select(0, turn).unbind(1)  # [B, side, side]
        top = (y[:, None] + dy[:, None] * at)[:, :, None, None]
        left = (x[:, None] + dx[:, None] * at)[:, :, None, None]
        pixel = (top + rows[:, None]) * _all(width) + left + columns[:, None]  # [B, T, side, side]
        stored = pixel + (frame[:, None] * (start[:, None] + at))[:, :, None, None]
        share = held.gains[_all(gain) + pixel * _all(mapped)]

        def photons(base: Tensor) -> Tensor:
            return held.light[_all(base) + stored].double() * share * scale * rate * factor

        exposed = photons(first)
        clean = photons(sharp) if held.sharp else exposed
        if self.windows.settings.force_exposure:
            own = _all(numpy_sums.mean(exposed.flatten(1))).clamp(min=DARKEST)
            exposed = exposed * torch.where(wanted.isnan(), 1.0, wanted / own)
        if held.defects:
            # Defects are those of a place in the full frame, and so are the random numbers of its pixels.
            fixed = (y[:, None, None] + rows) * width[:, None, None] + x[:, None, None] + columns
            numbers = held.pixels[array[:, None, None] + fixed * arrayed[:, None, None]]  # [B, side, side, 2]
            brighter, dark = (each[:, None] for each in numbers.unbind(-1))
            corner = top_of_clip + y, left_of_clip + x
            drawn_at = self._counters(arrayed, start * (1 - backwards), corner, (rows, columns))
            redraw = torch.arange(2, device=self.device)[:, None, None, None]
            upper, lower = (half[:, None, None, None, None] for half in (high, low))
            drawn = words_at(upper, lower, *drawn_at, redraw)
            codes = self._codes(exposed * brighter + dark, cells, law, steps, drawn)
        else:
            codes = self._codes(exposed, cells, law, steps, words(high, low, self.shape, redraws=2))
        if fills is not None:
            codes = fills.applied(codes, self.places_of_turns.index_select(0, turn))
        return {
            "codes": (codes.float() / _all(steps).float())[:, :, None],
            "target": torch.minimum(clean / white, ceiling).float()[:, :, None],
            "white": white.flatten(),
            "peak": peak.flatten(),
            "ppp": numpy_sums.mean(exposed.flatten(1)),
        }

    def _counters(
        self, arrayed: Tensor, number: Tensor, corner: tuple[Tensor, Tensor], inside: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return frame, row and column [B, 1, T or 1, side, side] of the random numbers of all pixels.

        Windows with defects (`arrayed`) have those of the full frame, from frame `number` and their `corner` on and not
        turned. Others have those of the turned window, from 0 on. `inside` are rows and columns before turns.
        """
        with_defects = arrayed[:, None, None] == 1
        frame = torch.arange(self.shape[0], device=self.device) + (number * arrayed)[:, None]
        places = zip(corner, inside, self.turned[0], strict=True)
        y, x = (torch.where(with_defects, first[:, None, None] + own, plain) for first, own, plain in places)
        return frame[:, None, :, None, None], y[:, None, None], x[:, None, None]

    def _codes(self, photons: Tensor, cells: Tensor, law: Tensor, steps: Tensor, drawn: Tensor) -> Tensor:
        """Return codes int64 [B, T, h, w]: how many steps lie at or below the number of each pixel."""
        number = uniform(*drawn.unbind(1))
        place = (photons.sqrt() * cells).clamp(max=float(CELLS))
        cell = place.long().clamp(max=CELLS - 1)
        share = place - cell
        at = _all(law) + cell
        codes = torch.zeros_like(cell)
        for bit in reversed(range(self.held.bits)):
            # Steps grow with k, so their number is found bit by bit: code >= c where the number reaches F_(c - 1).
            wanted = codes + (1 << bit)
            step = torch.minimum(wanted, _all(steps)) - 1
            c0, c1, c2, c3 = self.held.cubics[at + step * CELLS].unbind(-1)
            reached = number >= ((c3 * share + c2) * share + c1) * share + c0
            codes = torch.where(reached & (wanted <= _all(steps)), wanted, codes)
        return codes


def _all(each: Tensor) -> Tensor:
    """Return a number of each window [B] for all its pixels: [B, 1, 1, 1]."""
    return each[:, None, None, None]
