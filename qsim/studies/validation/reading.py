"""Measures how fast random training windows are read from a clip, and decoded from an mp4 of the same frames.

    run() -> ReadingReport: windows of 11 x 128 x 128 per second out of frames of 512 x 1024, ours and by FFmpeg

Both readers reopen their files for every window (no cache). Ours is one thread; FFmpeg may use all cores, seeks to the
key frame before the window and decodes from there. Both read the same windows in the same order. The pictures are equal
except for the loss of the video.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clip_info import ClipInfo
from qsim.clip.writer import ClipWriter
from qsim.formats import exporting
from qsim.streams.clip import Clip
from qsim.tables import text_table

FRAMES = 65
HEIGHT = 512
WIDTH = 1024
WINDOW = 11
CROP = 128
# wanted windows per second, and times the mp4
WANTED = 100.0
RATIO = 5.0

Place = tuple[int, int, int]  # first frame, y, x


@dataclass(frozen=True)
class ReadingReport:
    """Windows per second, and per second of processor time, which depends less on other programs."""

    clip: float
    mp4: float
    clip_processor: float
    mp4_processor: float
    difference: float  # rms between ours and the video's pictures, in units of white

    @property
    def ratio(self) -> float:
        """Windows per second from the clip folder, divided by those from the mp4."""
        return self.clip / self.mp4

    @property
    def ok(self) -> bool:
        """Whether both speeds are reached, and both readers read the same pictures."""
        return self.clip >= WANTED and self.ratio >= RATIO and self.difference < 0.05

    def to_dict(self) -> dict[str, object]:
        """Return the report for JSON."""
        sizes = {"window_shape": [WINDOW, CROP, CROP], "clip_shape": [FRAMES, HEIGHT, WIDTH]}
        return asdict(self) | sizes | {"ratio": self.ratio, "wanted": WANTED, "wanted_ratio": RATIO, "ok": self.ok}

    def lines(self) -> list[str]:
        """Return the report as lines for a terminal."""
        sides = (
            ("clip folder", self.clip, self.clip_processor, f"{WANTED:g}"),
            ("mp4", self.mp4, self.mp4_processor, ""),
            ("ratio", self.ratio, self.clip_processor / self.mp4_processor, f"{RATIO:g}"),
        )
        rows = [(name, f"{wall:.1f}", f"{processor:.1f}", wanted) for name, wall, processor, wanted in sides]
        return [
            f"windows of {WINDOW} x {CROP} x {CROP} at random places in a clip of {FRAMES} x {HEIGHT} x {WIDTH}",
            *text_table(rows, ("from", "windows/s", "per processor second", "wanted")),
            f"the same pictures to {self.difference:.3f} of white, the video's loss",
        ]


def run(seconds: float = 4.0, seed: int = 0) -> ReadingReport:
    """Write a clip and its video to a temporary folder and read both in turns, for so many seconds each."""
    with tempfile.TemporaryDirectory(prefix="qsim-reading-") as folder:
        clip = textured_clip(Path(folder) / "clip", seed)
        video = exporting.export(
            clip, Path(folder) / "clip.mp4", exporting.Export("mp4", "linear", 1.1, lossless=False)
        )
        sides: list[Callable[[Place], Array]] = [lambda at: from_clip(clip.path, at), lambda at: from_mp4(video, at)]
        rng = np.random.default_rng(seed)
        places = [_place(rng) for _ in range(8)]
        difference = np.mean([(sides[0](at) / 1.1 - sides[1](at) / 255.0) ** 2 for at in places])
        rates = [_rate(side, seconds / 2, seed + turn) for turn in range(2) for side in sides]
    ours = max(rates[0::2])
    theirs = max(rates[1::2])
    return ReadingReport(ours[0], theirs[0], ours[1], theirs[1], float(np.sqrt(difference)))


def textured_clip(path: Path, seed: int) -> Clip:
    """Write a clip of a texture that moves by 3 px per frame, with some noise: video can compress it, with a loss."""
    rng = np.random.default_rng(seed)
    texture = np.kron(rng.random((HEIGHT // 4, WIDTH // 4)), np.ones((4, 4)))
    info = ClipInfo(shape=(FRAMES, HEIGHT, WIDTH), frame_rate=2000.0, exposure=5e-4)
    with ClipWriter(path, info) as writer:
        for t in range(FRAMES):
            writer.add(t, np.roll(texture, 3 * t, axis=1) + 0.02 * rng.random((HEIGHT, WIDTH)))
    return Clip.open(path)


def from_clip(path: Path, place: Place) -> Array:
    """Return a window of radiance with our reader, float32 [11, 128, 128]."""
    first, y, x = place
    clip = Clip.open(path)
    return np.stack([clip.radiance(t, (y, x, CROP, CROP)) for t in range(first, first + WINDOW)])


def from_mp4(path: Path, place: Place) -> Array:
    """Return the same window with FFmpeg, uint8 [11, 128, 128]."""
    import av

    first, y, x = place
    found: list[Array] = []
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        tick = stream.average_rate * stream.time_base  # frames per unit of pts
        container.seek(int(first / tick), stream=stream)
        for frame in container.decode(stream):
            if round(frame.pts * tick) >= first:
                found.append(frame.to_ndarray(format="gray")[y : y + CROP, x : x + CROP])
            if len(found) == WINDOW:
                break
    return np.stack(found)


def _place(rng: np.random.Generator) -> Place:
    return (
        int(rng.integers(FRAMES - WINDOW + 1)),
        int(rng.integers(HEIGHT - CROP + 1)),
        int(rng.integers(WIDTH - CROP + 1)),
    )


def _rate(draw: Callable[[Place], Array], seconds: float, seed: int) -> tuple[float, float]:
    """Return windows per second, and per processor second, over at least so many seconds; the first is not timed."""
    rng = np.random.default_rng(seed)
    draw(_place(rng))
    done = 0
    started = time.perf_counter()
    worked = time.process_time()
    while True:
        draw(_place(rng))
        done += 1
        passed = time.perf_counter() - started
        if passed >= seconds:
            return done / passed, done / (time.process_time() - worked)
