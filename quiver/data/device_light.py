"""Holds the light of clips on a device, as float16, with all that photons and codes are computed from there.

    clip, noise -> slot of the device: radiance, sharp radiance, gains, the law of the sensor

Radiance is stored as half, so nothing is lost. The steps F_k of a law are cubics over the root of light, whose error is
measured: at most ERROR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy import ndarray as Array
from torch import Tensor

from qsim.optics.camera import Camera
from qsim.optics.radiometry import illumination, off_axis_cosines, photon_energy
from qsim.sensor.defects.fixed_pattern import lit
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.exposures import Timing
from qsim.streams.simulation import Draw
from quiver.data.clips import has_sharp, peak_of
from quiver.data.illumination import Illumination
from quiver.data.window_noise import pixel_array
from quiver.data.windows import Windows
from quiver.device import moved, pinned

CELLS = 1 << 15  # of the cubics, evenly spaced over the root of light
ERROR = 1e-13  # of a cubic, at most
FAINT = 1e-13  # chance of a code below the top one that the brightest light of the cubics leaves
WIDEST = 7  # bits of codes, by memory: 127 steps take 133 MB
FINEST = 1024  # parts of a pixel at which an axis may lie
INTEGERS = 15  # of a clip and noise: places in the memories of light, gains, laws and pixels; sizes, origin, planes
NUMBERS = 9  # of a clip and noise: factors of photons, white, peak


class Unfit(ValueError):
    """These windows are drawn on the host; the message states why."""


# ---- What is computed once


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


def is_in_place(noise: Illumination) -> bool:
    """Return whether the random numbers of a window are those of its place in the full frame, as `Windows` has them."""
    return noise.defects is not None or noise.timing != Timing()


def _pixels_of(clip: Clip, noise: Illumination, draw: Draw) -> tuple[Sensor, Array | None]:
    """Return the sensor that draws codes of exposures, and of pixels with maps two numbers each, float64 [H W, 2].

    They are the efficiency over the sensor's, and photons that would cause the dark events. Dead pixels are filled.
    """
    if noise.defects is None:
        return draw.plane, None
    array = pixel_array(noise.defects, draw.plane, clip.shape[1:], draw.origin)
    maps = array.maps
    # The factors of `lit`: light without a map is multiplied by 1, and 0 is added.
    sensor, dark = lit(array.sensor, np.zeros(clip.shape[1:]), clip.exposure, replace(maps, gain=None))
    found = np.ones((*clip.shape[1:], 2))
    if maps.gain is not None:
        found[..., 0] = maps.gain
    found[..., 1] = dark
    return sensor, found.reshape(-1, 2)


# ---- What a device holds


def size_of(clip: Clip) -> int:
    """Return how many numbers the light of a clip has, with its sharp frames."""
    return math.prod(clip.shape) * (1 + has_sharp(clip))


def light_of(clip: Clip, device: torch.device) -> Tensor:
    """Return the radiance of a clip and its sharp frames, float16 [size_of(clip)], on the host.

    `ValueError` for light that is not finite, or negative.
    """
    found = pinned(torch.empty(size_of(clip), dtype=torch.float16), device)
    frames = found.view(-1, *clip.shape[1:]).numpy()
    for t in range(len(clip)):
        frames[t] = clip.radiance(t)
        if has_sharp(clip):
            frames[len(clip) + t] = clip.sharp(t)
        for frame in frames[t :: len(clip)]:
            if not (np.isfinite(frame) & (frame >= 0)).all():
                raise ValueError(f"{clip.path}: radiance of frame {t} is not finite, or negative; run `qsim check`")
    return found


class HeldClips:
    """Clips in slots of a device's memory."""

    def __init__(self, windows: Windows, device: torch.device, sizes: Sequence[int], memory: int) -> None:
        """Make slots for so many numbers each. `Unfit` for more bytes than `memory`, which laws must fit into, too."""
        bytes_needed = 2 * sum(sizes)
        if bytes_needed > memory:
            raise Unfit(f"their light is {bytes_needed / 1e9:.3g} GB, and {memory / 1e9:.3g} GB are for it")
        self.windows = windows
        self.device = device
        self.memory = memory
        self.starts = np.cumsum([0, *sizes])
        rows = len(sizes) * len(windows.noise.noises)
        self.light = torch.empty(sum(sizes), dtype=torch.float16, device=device)
        self.gains = torch.ones(1, dtype=torch.float64, device=device)  # the first one is that of clips without a map
        self.cubics = torch.empty((0, 4), dtype=torch.float64, device=device)
        self.pixels = torch.ones((1, 2), dtype=torch.float64, device=device)  # the first one is that of no defects
        self.pixels[0, 1] = 0
        self.in_place = any(map(is_in_place, windows.noise.noises))
        self.planes = max(noise.planes for noise in windows.noise.noises)  # of a code, at most
        self.integers = torch.zeros((rows, INTEGERS), dtype=torch.int64, device=device)
        self.numbers = torch.ones((rows, NUMBERS), dtype=torch.float64, device=device)
        self.sharp = False  # whether a clip has sharp frames
        self.bits = 1  # of codes, at most
        self._gains: dict[Any, int] = {}
        self._laws: dict[tuple[Sensor, float], tuple[int, _Law]] = {}
        self._arrays: dict[Any, int] = {}

    def hold(self, slot: int, clip: Clip, light: Tensor) -> None:
        """Put a clip, whose light is that of `light_of`, into a slot; what was there is lost."""
        noises = self.windows.noise.noises
        first = int(self.starts[slot])
        self.light[first : first + len(light)] = moved(light, self.device)
        self.sharp |= has_sharp(clip)
        sharp = first + math.prod(clip.shape) * has_sharp(clip)
        gain = _gain_of(clip)
        place = self._place_of_gain(clip, gain)
        height, width = clip.shape[1:]
        integers = []
        numbers = []
        for noise in noises:
            draw = noise.draw(clip)
            drawing, pixels = _pixels_of(clip, noise, draw)
            law_at, law = self._place_of_law(drawing, clip.exposure)
            array = self._place_of_pixels((noise.defects, draw.plane, *clip.shape[1:], draw.origin), pixels)
            light_at = first, sharp, height * width, width, place, int(gain.map is not None)
            pixels_at = array, int(pixels is not None), int(is_in_place(noise)), *draw.origin
            integers.append((*light_at, law_at, law.steps, *pixels_at, draw.planes, draw.sensor.levels - 1))
            white = draw.sensor.white(clip.exposure * draw.planes)
            forced = self.windows.settings.force_exposure
            peak = white if forced else peak_of(draw.level.ppp * draw.planes)
            ceiling = max(self.windows.settings.ceiling, peak / white)
            wanted = noise.ppp if forced and noise.ppp is not None else math.nan
            factors = gain.scale, gain.rate, draw.level.factor, draw.level.factor * draw.planes
            numbers.append((*factors, law.rate, white, peak, ceiling, wanted))
        rows = slice(slot * len(noises), (slot + 1) * len(noises))
        self.integers[rows] = self._sent(torch.tensor(integers))
        self.numbers[rows] = self._sent(torch.tensor(numbers, dtype=torch.float64))

    @property
    def bytes(self) -> int:
        """The memory that light, gains and laws take."""
        return sum(held.nbytes for held in (self.light, self.gains, self.cubics, self.pixels))

    def _sent(self, numbers: Tensor) -> Tensor:
        """Return numbers on the device, without waiting for it."""
        return moved(pinned(numbers, self.device), self.device)

    def _place_of_gain(self, clip: Clip, gain: _Gain) -> int:
        if gain.map is None:
            return 0
        key = clip.camera, clip.origin, clip.shape[1:]
        if key not in self._gains:
            self._gains[key] = len(self.gains)
            self.gains = torch.cat((self.gains, self._sent(torch.from_numpy(gain.map.ravel().copy()))))
            self._check_memory()
        return self._gains[key]

    def _place_of_pixels(self, key: Any, pixels: Array | None) -> int:
        if pixels is None:
            return 0
        if key not in self._arrays:
            self._arrays[key] = len(self.pixels)
            self.pixels = torch.cat((self.pixels, self._sent(torch.from_numpy(pixels))))
            self._check_memory()
        return self._arrays[key]

    def _place_of_law(self, sensor: Sensor, exposure: float) -> tuple[int, _Law]:
        if (sensor, exposure) not in self._laws:
            law = _law_of(sensor, exposure)
            self._laws[sensor, exposure] = len(self.cubics), law
            self.cubics = torch.cat((self.cubics, self._sent(torch.from_numpy(law.cubics))))
            self.bits = max(self.bits, law.steps.bit_length())
            self._check_memory()
        return self._laws[sensor, exposure]

    def _check_memory(self) -> None:
        if self.bytes > self.memory:
            raise Unfit(
                f"their light and its laws are {self.bytes / 1e9:.3g} GB, and {self.memory / 1e9:.3g} GB are for them"
            )
