"""Draws whole batches of training windows on a device that holds the radiance of all clips, as float16.

    place of a window (host) -> radiance at its pixels -> photons, in float64 -> codes, targets: all on the device

The windows are those of `Windows`, to the bit: every number is computed by the same operations in the same order. Only
places and keys come from the host, some numbers for each window, and nothing is asked of the device.

Codes are #{k : U >= F_k} of a number U of 64 bits. F_k is read from cubics over the root of light, whose error is
measured: at most ERROR. So a code differs from that of `draw_codes` with a chance of about ERROR for each pixel and k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor
from torch.utils.data import Dataset

from qsim.optics.camera import Camera
from qsim.optics.radiometry import illumination, off_axis_cosines, photon_energy
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.exposures import Timing
from quiver.data import numpy_sums
from quiver.data.clips import has_sharp, peak_of
from quiver.data.device_words import uniform, words
from quiver.data.mosaic_windows import TURNS, turned_frame
from quiver.data.windows import DARKEST, Windows
from quiver.device import moved

CELLS = 1 << 15  # of the cubics, evenly spaced over the root of light
ERROR = 1e-13  # of a cubic, at most
FAINT = 1e-13  # chance of a code below the top one that the brightest light of the cubics leaves
WIDEST = 7  # bits of codes, by memory: 127 steps take 133 MB
FINEST = 1024  # parts of a pixel at which an axis may lie


class Unfit(ValueError):
    """These windows are drawn on the host; the message states why."""


# ---- What a device holds


@dataclass(frozen=True)
class _Law:
    """The steps F_k of one sensor and exposure, as cubics over the root of photons."""

    rate: float  # cells per root of a photon
    cubics: Array  # float64 [steps * CELLS, 4]: coefficients in the share of the cell, constant first
    steps: int


def _law_of(sensor: Sensor, exposure: float) -> _Law:
    """Return the cubics of a sensor. `Unfit` where they would be too many or not exact."""
    if sensor.bits > WIDEST:
        raise Unfit(f"codes of {sensor.bits} bits have too many steps")
    if np.isfinite(sensor.brightest(exposure)):
        raise Unfit(f"codes of {type(sensor).__name__} fall again with light")
    brightest = sensor.white(exposure)
    while sensor.cdf(np.array([brightest]), exposure)[0, -2] > FAINT:
        brightest *= 1.25
        if not brightest < 1e6 * sensor.white(exposure):
            raise Unfit(f"codes of {type(sensor).__name__} never reach their top")
    root = np.linspace(0, np.sqrt(brightest), CELLS + 1)
    width = root[1]
    value = sensor.cdf(root**2, exposure)[:, :-1].T
    slope = (sensor.dcdf(root**2, exposure)[:, :-1] * (2 * root * width)[:, None]).T
    v0, v1 = value[:, :-1], value[:, 1:]
    d0, d1 = slope[:, :-1], slope[:, 1:]
    cubics = np.stack([v0, d0, 3 * (v1 - v0) - 2 * d0 - d1, 2 * (v0 - v1) + d0 + d1], axis=-1)
    middle = (root[1:] + root[:-1]) / 2
    error = np.abs(cubics @ 0.5 ** np.arange(4) - sensor.cdf(middle**2, exposure)[:, :-1].T).max()
    if error > ERROR:
        raise Unfit(f"the steps of {type(sensor).__name__} are no cubics: they differ by {error:.1g}")
    return _Law(CELLS / float(np.sqrt(brightest)), cubics.reshape(-1, 4), len(value))


@dataclass(frozen=True)
class _Gain:
    """Photons of a clip over its radiance: radiance * map * scale * rate * factor, in this order."""

    map: Array | None  # float64 [H, W]; None: 1 everywhere
    scale: float
    rate: float


def _gain_of(clip: Clip) -> _Gain:
    """Return how `clip_photons` computes photons of a clip. `Unfit` where a crop would round it differently."""
    camera = clip.camera
    if camera is None:
        return _Gain(None, 1.0, 1.0)
    if camera.zoom is not None:
        raise Unfit(f"{clip.name}: its lens changes with time")
    scale = np.pi * camera.transmission / (4 * camera.working_f_number**2)
    rate = camera.pixel_area * clip.exposure / photon_energy(camera.wavelength)
    if camera.lens is None and not camera.vignetting:
        return _Gain(None, scale, rate)
    return _Gain(_fall_off(clip, camera, scale), 1.0 if camera.lens is None else scale, rate)


def _fall_off(clip: Clip, camera: Camera, scale: float) -> Array:
    """Return the share of light [H, W] behind a lens, or of an ideal one with vignetting the share times `scale`."""
    height, width = clip.shape[1:]
    axis = camera.axis[1] - clip.origin[0], camera.axis[0] - clip.origin[1]
    if any((each * FINEST) % 1 for each in camera.axis):  # then a place less the axis is exact, wherever a crop begins
        raise Unfit(f"{clip.name}: the axis of its lens is not at a simple fraction of a pixel")
    if camera.lens is None:
        return scale * off_axis_cosines(height, width, *axis, camera.focal_pixels) ** 4
    return illumination(height, width, *axis, camera.focal_pixels, camera.lens, camera.vignetting)


# ---- Places, which the host draws


class Places(Dataset[dict[str, Any]]):
    """Where windows lie, and under which key: what a device needs to draw them. A `torch` data set, as `Windows`.

    An item holds `place`, int64 [10], which `DeviceWindows` reads, `sample` and `key` as of `Windows`.
    """

    def __init__(self, windows: Windows) -> None:
        self.windows = windows

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, n: int) -> dict[str, Any]:
        place = self.windows.place(n)
        row = place.clip * len(self.windows.noise.noises) + place.light
        key = place.key.philox_key
        numbers = (row, place.start, place.y, place.x, *place.drift, place.turn, int(place.backwards))
        place_of_window = torch.tensor((*numbers, key >> 32, key & 0xFFFFFFFF))
        return {"place": place_of_window, "sample": n, "key": self.windows.text_of(place)}


# ---- Windows


def why_not(windows: Windows) -> str | None:
    """Return why no device draws these windows; None where one can, as far as settings and noises tell."""
    settings = windows.settings
    if windows.prepare is not None:
        return "the network takes more inputs, which are computed where windows are drawn"
    if settings.still:
        return "they have copies at rest"
    if windows.filters is not None:
        return "they have colour filters"
    for noise in windows.noise.noises:
        if noise.defects is not None or noise.timing != Timing() or noise.sensing.diffraction:
            return f"{noise.label}: has defects, diffraction, or codes of several or late exposures"
    return None


class DeviceWindows:
    """Windows whose light lies on a device: batches of places in, batches of `Windows` out."""

    def __init__(self, windows: Windows, device: torch.device, memory: int) -> None:
        """Read all clips onto the device. `Unfit` for windows that it cannot draw, and for more bytes than `memory`."""
        problem = why_not(windows)
        if problem is not None:
            raise Unfit(problem)
        self.windows = windows
        self.device = device
        self.places = Places(windows)
        self.shape = (windows.settings.frames, windows.settings.crop, windows.settings.crop)
        stored = sum(math.prod(clip.shape) * (1 + has_sharp(clip)) for clip in windows.clips)
        if 2 * stored > memory:
            raise Unfit(f"their light is {2 * stored / 1e9:.3g} GB, and {memory / 1e9:.3g} GB are for it")
        self.light = torch.empty(stored, dtype=torch.float16, device=device)
        gains: dict[Any, tuple[int, Array]] = {}
        laws: dict[tuple[Sensor, float], tuple[int, _Law]] = {}
        integers: list[tuple[int, ...]] = []
        numbers: list[tuple[float, ...]] = []
        self.sharp = False
        free = 0  # of the memory of light
        self.sizes = [1, 0]  # of the memories of gains and laws
        for clip in windows.clips:
            first = free
            free = self._read(clip, first, clip.radiance)
            sharp = first
            if has_sharp(clip):
                self.sharp = True
                sharp = free
                free = self._read(clip, sharp, clip.sharp)
            for noise in windows.noise.noises:
                draw = noise.draw(clip)
                gain = _gain_of(clip)
                at = self._place_of_gain(gains, clip, gain)
                law_at, law = self._place_of_law(laws, draw.sensor, clip.exposure)
                height, width = clip.shape[1:]
                integers.append((first, sharp, height * width, width, at, int(gain.map is not None), law_at, law.steps))
                white = draw.sensor.white(clip.exposure)
                forced = windows.settings.force_exposure
                peak = white if forced else peak_of(draw.level.ppp)
                ceiling = max(windows.settings.ceiling, peak / white)
                wanted = noise.ppp if forced and noise.ppp is not None else math.nan
                numbers.append((gain.scale, gain.rate, draw.level.factor, law.rate, white, peak, ceiling, wanted))
        held = 2 * stored + 8 * self.sizes[0] + 32 * self.sizes[1]
        if held > memory:
            raise Unfit(f"their light and its laws are {held / 1e9:.3g} GB, and {memory / 1e9:.3g} GB are for them")
        maps = [np.ones(1), *(found.ravel() for _, found in gains.values())]
        self.gains = torch.from_numpy(np.concatenate(maps)).to(device)
        self.cubics = torch.from_numpy(np.concatenate([law.cubics for _, law in laws.values()])).to(device)
        self.integers = torch.tensor(integers, device=device)
        self.numbers = torch.tensor(numbers, dtype=torch.float64, device=device)
        self.bits = max(law.steps for _, law in laws.values()).bit_length()
        grid: Array = np.indices(self.shape[1:])
        turned: Array = np.stack([turned_frame(grid, turn) for turn in TURNS])
        self.turned = torch.from_numpy(np.ascontiguousarray(turned)).to(device)  # [8, 2, side, side]

    def _read(self, clip: Clip, first: int, read: Callable[[int], Array]) -> int:
        """Copy the frames of a clip to the device; return the place behind them. `ValueError` for impossible light."""
        frame = math.prod(clip.shape[1:])
        for t in range(len(clip)):
            light = read(t).astype(np.float16)
            if not (np.isfinite(light) & (light >= 0)).all():
                raise ValueError(f"{clip.path}: radiance of frame {t} is not finite, or negative; run `qsim check`")
            at = first + t * frame
            self.light[at : at + frame] = torch.from_numpy(light.ravel()).to(self.device)
        return first + len(clip) * frame

    def _place_of_gain(self, gains: dict[Any, tuple[int, Array]], clip: Clip, gain: _Gain) -> int:
        if gain.map is None:
            return 0
        key = clip.camera, clip.origin, clip.shape[1:]
        if key not in gains:
            gains[key] = self.sizes[0], gain.map
            self.sizes[0] += gain.map.size
        return gains[key][0]

    def _place_of_law(
        self, laws: dict[tuple[Sensor, float], tuple[int, _Law]], sensor: Sensor, exposure: float
    ) -> tuple[int, _Law]:
        if (sensor, exposure) not in laws:
            law = _law_of(sensor, exposure)
            laws[sensor, exposure] = self.sizes[1], law
            self.sizes[1] += len(law.cubics)
        return laws[sensor, exposure]

    def draw(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return the windows of a batch of `places`, with what `Windows` states of them, on the device."""
        found = self.drawn(moved(batch["place"], self.device))
        return found | {"sample": batch["sample"], "key": batch["key"]}

    def drawn(self, place: Tensor) -> dict[str, Tensor]:
        """Return codes, target, white, peak and ppp of windows at places int64 [B, 10] on the device."""
        row, start, y, x, dy, dx, turn, backwards, high, low = place.unbind(1)
        first, sharp, frame, width, gain, mapped, law, steps = self.integers.index_select(0, row).unbind(1)
        # float64 [B, 1, 1, 1]
        scale, rate, factor, cells, white, peak, ceiling, wanted = (
            each[:, None, None, None] for each in self.numbers.index_select(0, row).unbind(1)
        )
        frames = self.shape[0]
        order = torch.arange(frames, device=self.device)
        at = order + backwards[:, None] * (frames - 1 - 2 * order)  # [B, T], backwards from the last on
        rows, columns = self.turned.index_select(0, turn).unbind(1)  # [B, side, side]
        top = (y[:, None] + dy[:, None] * at)[:, :, None, None]
        left = (x[:, None] + dx[:, None] * at)[:, :, None, None]
        pixel = (top + rows[:, None]) * _all(width) + left + columns[:, None]  # [B, T, side, side]
        stored = pixel + (frame[:, None] * (start[:, None] + at))[:, :, None, None]
        share = self.gains[_all(gain) + pixel * _all(mapped)]

        def photons(base: Tensor) -> Tensor:
            return self.light[_all(base) + stored].double() * share * scale * rate * factor

        exposed = photons(first)
        clean = photons(sharp) if self.sharp else exposed
        if self.windows.settings.force_exposure:
            own = _all(numpy_sums.mean(exposed.flatten(1))).clamp(min=DARKEST)
            exposed = exposed * torch.where(wanted.isnan(), 1.0, wanted / own)
        codes = self._codes(exposed, cells, law, steps, words(high, low, self.shape, redraws=2))
        return {
            "codes": (codes.float() / _all(steps).float())[:, :, None],
            "target": torch.minimum(clean / white, ceiling).float()[:, :, None],
            "white": white.flatten(),
            "peak": peak.flatten(),
            "ppp": numpy_sums.mean(exposed.flatten(1)),
        }

    def _codes(self, photons: Tensor, cells: Tensor, law: Tensor, steps: Tensor, drawn: Tensor) -> Tensor:
        """Return codes int64 [B, T, h, w]: how many steps lie at or below the number of each pixel."""
        number = uniform(*drawn.unbind(1))
        place = (photons.sqrt() * cells).clamp(max=float(CELLS))
        cell = place.long().clamp(max=CELLS - 1)
        share = place - cell
        at = _all(law) + cell
        codes = torch.zeros_like(cell)
        for bit in reversed(range(self.bits)):
            # Steps grow with k, so their number is found bit by bit: code >= c where the number reaches F_(c - 1).
            wanted = codes + (1 << bit)
            step = torch.minimum(wanted, _all(steps)) - 1
            c0, c1, c2, c3 = self.cubics[at + step * CELLS].unbind(-1)
            reached = number >= ((c3 * share + c2) * share + c1) * share + c0
            codes = torch.where(reached & (wanted <= _all(steps)), wanted, codes)
        return codes


def _all(each: Tensor) -> Tensor:
    """Return a number of each window [B] for all its pixels: [B, 1, 1, 1]."""
    return each[:, None, None, None]
