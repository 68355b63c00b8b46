"""Makes a clip of waves that move by whole pixels, so that its statistics do not change with time."""

import numpy as np

from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.streams.clip import Clip

SIZE = (48, 64)


def wave_clip(path, frames: int, speed: int, frame_rate: float = 10_000.0, *, still: int = 0) -> Clip:
    """Write a clip of a periodic texture that moves to the right by `speed` px per frame.

    The first `still` rows rest.
    """
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    turn = 2 * np.pi / SIZE[1]
    texture = 1.0 + 0.5 * np.sin(3 * turn * x) + 0.3 * np.cos(7 * turn * x + y / 5) + 0.15 * np.sin(16 * turn * x)
    meta = {"shape": [frames, *SIZE], "frame_rate": frame_rate, "exposure": 1 / frame_rate, "radiance_unit": RELATIVE}
    flow = np.zeros((2, *SIZE), np.float32)
    flow[0, still:] = speed
    truth = {"flow": flow, "flow_back": -flow, "valid": np.ones(SIZE, bool)}
    with ClipWriter(path, meta) as writer:
        for t in range(frames):
            moved = np.roll(texture, speed * t, axis=1)
            moved[:still] = texture[:still]
            writer.add(t, moved.astype(np.float32), truth=truth)
    return Clip.open(path)
