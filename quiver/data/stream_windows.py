"""Draws training windows from one stored stream, for networks that learn from its noisy frames alone.

Sample n is a function of (seed, n) alone: its place and its turn. Its noise is that of the stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import Dataset

from qsim.keys import Key
from qsim.streams.clip import Clip
from quiver.data.codes import Codes, codes_of, light_of, open_stream, stream_codes
from quiver.data.hot_pixels import scanned
from quiver.data.window_noise import WindowPlace
from quiver.data.windows import WindowSettings, as_input, turned

COUNTING = (0.9, 1.25)  # codes per electron at which codes of a QIS are photon counts, nearly
BLACK = 0.1  # codes: the largest offset of such a QIS
BLUR = 0.3  # e- rms: its largest read noise, with which nine codes in ten are the electrons
LOST = 0.05  # of the events of the mean light: the largest loss, by which restored light is too dark


@dataclass(frozen=True)
class Law:
    """How photons make the codes of a stream, as far as single photons can be taken from them."""

    planes: bool  # a code is the sum of binary planes; else a count of photons
    dark: float  # what comes without light, in units of white


def law_of(codes: Codes) -> Law:
    """Return the law of a stream: sums of planes of a clocked SPAD array, else photon counts.

    `ValueError` for a stream whose codes are neither: a photon cannot be taken from them.
    """
    sensor = codes.sensor
    exposure = codes.exposure
    reason = _no_counts(codes)
    if reason is not None:
        raise ValueError(
            f"{codes.name}: {reason}; bit2bit needs photon counts of one kind: give a stream of summed planes, or of "
            "about one code per electron with little read noise, no offset and rare saturation"
        )
    dark = sensor.dark_rate * exposure / (sensor.efficiency * sensor.white(exposure))
    return Law(sensor.sums_planes, float(dark))


def _no_counts(codes: Codes) -> str | None:
    """Return why the codes of a stream are no photon counts of one kind; None if they are such."""
    sensor = codes.sensor
    if codes.colour is not None:
        return "its codes are those of colour filters"
    if codes.shares is not None:
        return "its codes are those of different exposures"
    if sensor.keeps_charge:
        return "its codes are spikes of collected charge"
    if sensor.sums_planes:
        return None
    if not COUNTING[0] <= sensor.gain <= COUNTING[1]:
        return f"its codes are {sensor.gain:.3g} per electron"
    if abs(sensor.offset) > BLACK:
        return f"its codes are shifted by an offset of {sensor.offset:.3g}"
    if sensor.blur > BLUR:
        return f"its codes are blurred by a read noise of {sensor.blur:.3g} electrons"
    light = light_of(codes)
    counts = sensor.gain * (sensor.efficiency * light + sensor.dark_rate * codes.exposure)
    lost = 1 - float(sensor.mean(np.array([light]), codes.exposure)[0]) / counts
    if lost > LOST:
        return f"its codes lose {100 * lost:.0f} % of the events of the mean light to saturation, dead time or rounding"
    return None


def stream_at(path: Path, scan: bool | None = None) -> Codes:
    """Return the codes of a stored stream, or of the only stream of a clip folder. `ValueError` for other paths.

    Hot pixels of a recording without a map are filled (hot_pixels.py), unless `scan` is False.
    """
    if path.is_dir():
        clip = Clip.open(path)
        if len(clip.streams) != 1:
            raise ValueError(
                f"{path}: has the streams {', '.join(clip.streams) or 'none'}; name one of their .npy files"
            )
        return scanned(stream_codes(clip.stream(clip.streams[0])), scan)
    if not path.with_suffix(".json").is_file():
        raise FileNotFoundError(f"{path}: no stored stream, which is a .npy with its .json; see `qsim sense`")
    return scanned(codes_of(open_stream(path)), scan)


class StreamWindows(Dataset[dict[str, Any]]):
    """Windows of a stream: a `torch` data set.

    An item holds codes float32 [T, 1, h, w] in [0, 1], sample (its number) and key (a text with its place).
    `ValueError` for a stream that is shorter or smaller than a window, or whose codes are no photon counts.
    """

    def __init__(self, codes: Codes, settings: WindowSettings) -> None:
        length, height, width = codes.shape
        if length < settings.frames or min(height, width) < settings.crop:
            raise ValueError(
                f"{codes.name} is {length} x {height} x {width}; a window needs {settings.frames} frames of "
                f"{settings.crop} x {settings.crop} px; choose a smaller crop= or fewer frames="
            )
        law_of(codes)
        self.codes = codes
        self.settings = settings

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how a worker makes the same windows: it opens the stored stream again."""
        return _opened, (self.codes.source, self.settings, False if self.codes.unmapped else None)

    def __len__(self) -> int:
        """Return how many windows hold as many codes as the stream; numbers beyond are windows, too."""
        frames = self.settings.frames
        crop = self.settings.crop
        return int(np.ceil(np.prod(self.codes.shape) / (frames * crop**2)))

    def __getitem__(self, n: int) -> dict[str, Any]:
        settings = self.settings
        rng = np.random.default_rng((self.settings.seed, n))
        length, height, width = self.codes.shape
        start, y, x = (
            int(rng.integers(most - size + 1))
            for most, size in ((length, settings.frames), (height, settings.crop), (width, settings.crop))
        )
        turn = int(rng.integers(8)) if settings.flips else 0
        backwards = bool(rng.integers(2)) if settings.reverse else False
        place = WindowPlace(0, start, y, x, (0, 0), 0, turn, backwards, Key(settings.seed, n))
        part = self.codes.read(start, start + settings.frames)[:, y : y + settings.crop, x : x + settings.crop]
        key = f"{self.codes.name} frame {start}, (y, x) ({y}, {x}), turn {turn}"
        return {"codes": as_input(turned(part, place), self.codes.sensor), "sample": n, "key": key}


def _opened(path: str, settings: WindowSettings, scan: bool | None) -> StreamWindows:
    """Return the windows of a stored stream."""
    return StreamWindows(stream_at(Path(path), scan), settings)
