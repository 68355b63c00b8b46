"""Makes a clip of five frames of 10 x 7 pixels with ground truth, for tests of clip folders."""

from pathlib import Path
from typing import Any

import numpy as np

from qsim.clip.clip_info import PHYSICAL
from qsim.clip.writer import ClipWriter
from qsim.streams.clip import Clip

FRAMES = 5
HEIGHT = 10
WIDTH = 7
CAMERA = {
    "focal_length": 8e-3,
    "f_number": 2.8,
    "pixel_pitch": 1.1e-6,
    "height": HEIGHT,
    "width": WIDTH,
    "transmission": 0.9,
}


def meta(**changes: Any) -> dict[str, Any]:
    base = {
        "shape": [FRAMES, HEIGHT, WIDTH],
        "frame_rate": 2000.0,
        "shutter": 0.0,
        "exposure": 5e-4,
        "radiance_unit": PHYSICAL,
        "camera": CAMERA,
    }
    return base | changes


def radiance(t: int) -> np.ndarray:
    return np.random.default_rng(t).random((HEIGHT, WIDTH)).astype(np.float16).astype(np.float32)


def truth(t: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(100 + t)
    return {
        "flow": rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32),
        "flow_back": rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32),
        "valid": rng.random((HEIGHT, WIDTH)) < 0.8,
        "depth": np.where(rng.random((HEIGHT, WIDTH)) < 0.2, np.inf, 3.5).astype(np.float32),
        "body_id": rng.integers(-1, 4, (HEIGHT, WIDTH)).astype(np.int32),
    }


def write(path: Path, *, force: bool = False, **changes: Any) -> Clip:
    with ClipWriter(path, meta(**changes), force=force) as writer:
        for t in range(FRAMES):
            if not writer.has(t):
                sharp = radiance(50 + t) if t == 2 else None
                writer.add(t, radiance(t), sharp=sharp, truth=truth(t), error=0.01, fireflies=t)
    return Clip.open(path)
