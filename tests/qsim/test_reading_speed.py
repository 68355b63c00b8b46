"""Random crops for training: 100 windows of 11 x 128 x 128 per second or more, 5 times as fast as from mp4 or more."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from qsim import export
from qsim.clip import RELATIVE, Clip, ClipWriter

FRAMES, HEIGHT, WIDTH = 32, 512, 1024
WINDOW, CROP = 11, 128


def textured_clip(path: Path) -> Clip:
    """A texture that moves by 3 pixels per frame, with some noise: neither trivial nor impossible to compress."""
    rng = np.random.default_rng(0)
    texture = np.kron(rng.random((HEIGHT // 4, WIDTH // 4)), np.ones((4, 4)))
    meta = {"shape": [FRAMES, HEIGHT, WIDTH], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE}
    with ClipWriter(path, meta | {"camera": None}) as writer:
        for t in range(FRAMES):
            writer.add(t, np.roll(texture, 3 * t, axis=1) + 0.02 * rng.random((HEIGHT, WIDTH)))
    return Clip.open(path)


def rate(draw: Callable[[np.random.Generator], object], seconds: float) -> float:
    rng = np.random.default_rng(1)
    draw(rng)
    done, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        draw(rng)
        done += 1
    return done / (time.perf_counter() - started)


@pytest.mark.slow
def test_random_crops_are_quick(tmp_path: Path):
    av = pytest.importorskip("av")
    clip = textured_clip(tmp_path / "clip")
    video = export.export(clip, tmp_path / "clip.mp4", export.Export("mp4", lossless=False))

    def place(rng: np.random.Generator) -> tuple[int, int, int]:
        return (int(rng.integers(FRAMES - WINDOW)), int(rng.integers(HEIGHT - CROP)), int(rng.integers(WIDTH - CROP)))

    def ours(rng: np.random.Generator) -> np.ndarray:
        t, y, x = place(rng)
        opened = Clip.open(clip.path)  # as a loader would that forgets its clips
        return np.stack([opened.radiance(i, (y, x, CROP, CROP)) for i in range(t, t + WINDOW)])

    def theirs(rng: np.random.Generator) -> np.ndarray:
        t, y, x = place(rng)
        with av.open(str(video)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            assert stream.average_rate is not None
            assert stream.time_base is not None
            container.seek(int(t / stream.average_rate / stream.time_base), stream=stream)
            found = []
            for frame in container.decode(stream):
                assert frame.pts is not None
                if round(frame.pts * stream.time_base * stream.average_rate) >= t:
                    found.append(frame.to_ndarray(format="gray")[y : y + CROP, x : x + CROP])
                if len(found) == WINDOW:
                    break
        return np.stack(found)

    assert ours(np.random.default_rng(3)).shape == theirs(np.random.default_rng(3)).shape == (WINDOW, CROP, CROP)
    crops, decoded = rate(ours, 3), rate(theirs, 6)
    print(f"{crops:.0f} crops per second from a clip, {decoded:.1f} from mp4: {crops / decoded:.0f} times as fast")
    assert crops >= 100
    assert crops >= 5 * decoded
