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
from dataclasses import dataclass
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
            found |= stated(*windows.seen_by(place), n)
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
        timing = noise.timing
        if timing != Timing(timing.frames, timing.summed) or noise.sensing.diffraction:
            return f"{noise.label}: has diffraction, or exposures that are late, unequal or of light that drifts"
        if timing.frames > 1 and not timing.summed:
            return f"{noise.label}: has codes of several slices"
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
        *light_at, law, steps, array, arrayed, in_place, clip_y, clip_x, planes, highest = held.integers.index_select(
            0, row
        ).unbind(1)
        first, sharp, frame, width, gain, mapped = light_at
        # float64 [B, 1, 1, 1]
        scale, rate, factor, factor_of_code, cells, white, peak, ceiling, wanted = (
            each[:, None, None, None] for each in held.numbers.index_select(0, row).unbind(1)
        )
        frames = self.shape[0]
        order = torch.arange(frames, device=self.device)
        at = order + backwards[:, None] * (frames - 1 - 2 * order)  # [B, T], backwards from the last on
        rows, columns = self.turned.index_select(0, turn).unbind(1)  # [B, side, side]
        top = (y[:, None] + dy[:, None] * at)[:, :, None, None]
        left = (x[:, None] + dx[:, None] * at)[:, :, None, None]
        pixel = (top + rows[:, None]) * _all(width) + left + columns[:, None]  # [B, T, side, side]
        share = held.gains[_all(gain) + pixel * _all(mapped)]
        light = _Light(
            held=held,
            pixel=pixel,
            share=share,
            codes=start[:, None] + at,
            frame=frame,
            planes=planes,
            backwards=backwards,
            gain=(scale, rate),
        )
        exposed = light.of_code(first, factor)
        clean = exposed
        if held.planes > 1 or held.sharp:
            clean = light.middle(sharp, factor_of_code)
        brighter: Tensor | float = 1.0
        if self.windows.settings.force_exposure:
            own = _all(numpy_sums.mean(exposed.flatten(1))).clamp(min=DARKEST)
            brighter = torch.where(wanted.isnan(), 1.0, wanted / own)
            exposed = exposed * brighter
        if held.in_place:
            # Defects are those of a place in the full frame, and so are the random numbers of its pixels.
            fixed = (y[:, None, None] + rows) * width[:, None, None] + x[:, None, None] + columns
            numbers = held.pixels[array[:, None, None] + fixed * arrayed[:, None, None]]  # [B, side, side, 2]
            efficient, dark = (each[:, None] for each in numbers.unbind(-1))
            corner = clip_y + y, clip_x + x
            code, line, column = self._counters(in_place, start * (1 - backwards), corner, (rows, columns))
            redraw = torch.arange(2, device=self.device)[:, None, None, None]
            upper, lower = (half[:, None, None, None, None] for half in (high, low))
            codes = torch.zeros_like(pixel)
            for number in range(held.planes):
                plane = code * planes[:, None, None, None, None] + number
                drawn = words_at(upper, lower, plane, line, column, redraw)
                photons = light.of_plane(number, first, factor) * brighter * efficient + dark
                fired = self._codes(photons, cells, law, steps, drawn)
                codes = codes + torch.where(_all(planes) > number, fired, 0)
        else:
            codes = self._codes(exposed, cells, law, steps, words(high, low, self.shape, redraws=2))
        if fills is not None:
            codes = fills.applied(codes, self.places_of_turns.index_select(0, turn))
        return {
            "codes": (codes.float() / _all(highest).float())[:, :, None],
            "target": torch.minimum(clean / white, ceiling).float()[:, :, None],
            "white": white.flatten(),
            "peak": peak.flatten(),
            "ppp": numpy_sums.mean(exposed.flatten(1)),
        }

    def _counters(
        self, in_place: Tensor, number: Tensor, corner: tuple[Tensor, Tensor], inside: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return code, row and column [B, 1, T or 1, side, side] of the random numbers of all pixels.

        Windows that are drawn `in_place` have those of the full frame, from code `number` and their `corner` on and not
        turned. Others have those of the turned window, from 0 on. `inside` are rows and columns before turns.
        """
        placed = in_place[:, None, None] == 1
        code = torch.arange(self.shape[0], device=self.device) + (number * in_place)[:, None]
        places = zip(corner, inside, self.turned[0], strict=True)
        y, x = (torch.where(placed, first[:, None, None] + own, plain) for first, own, plain in places)
        return code[:, None, :, None, None], y[:, None, None], x[:, None, None]

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


@dataclass(frozen=True, eq=False)
class _Light:
    """The light of a batch of windows, turned and in the order of exposure; a code has `planes` exposures."""

    held: HeldClips
    pixel: Tensor  # int64 [B, T, h, w], in its frame
    share: Tensor  # float64 [B, T, h, w]
    codes: Tensor  # int64 [B, T], their numbers in the clip
    frame: Tensor  # int64 [B], pixels of a frame
    planes: Tensor  # int64 [B]
    backwards: Tensor  # int64 [B], 0 or 1
    gain: tuple[Tensor, Tensor]  # float64 [B, 1, 1, 1]

    def of_code(self, base: Tensor, strength: Tensor) -> Tensor:
        """Return the photons of each code."""
        found = self.of_plane(0, base, strength)
        for number in range(1, self.held.planes):
            found = found + self.of_plane(number, base, strength)
        return found

    def of_plane(self, number: int, base: Tensor, strength: Tensor) -> Tensor:
        """Return the photons of a plane, in the order of exposure; 0 where a code has fewer."""
        if self.held.planes == 1:
            return self._photons(base, strength, self.codes)
        last = self.planes - 1 - number
        own = torch.where(self.backwards == 1, last, number).clamp(min=0).minimum(self.planes - 1)
        photons = self._photons(base, strength, self.codes * self.planes[:, None] + own[:, None])
        return torch.where(_all(last) >= 0, photons, 0.0)

    def middle(self, base: Tensor, strength: Tensor) -> Tensor:
        """Return the photons of the clip frame in the middle of each code."""
        if self.held.planes == 1:
            return self._photons(base, strength, self.codes)
        return self._photons(base, strength, self.codes * self.planes[:, None] + (self.planes // 2)[:, None])

    def _photons(self, base: Tensor, strength: Tensor, frames_of_clip: Tensor) -> Tensor:
        stored = self.pixel + (self.frame[:, None] * frames_of_clip)[:, :, None, None]
        scale, rate = self.gain
        return self.held.light[_all(base) + stored].double() * self.share * scale * rate * strength


def _all(each: Tensor) -> Tensor:
    """Return a number of each window [B] for all its pixels: [B, 1, 1, 1]."""
    return each[:, None, None, None]
