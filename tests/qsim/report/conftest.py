"""Shares a clip of noise, and a folder with every kind of result that a page shows."""

import json

import numpy as np
import pytest
from clips import describe_video, square_clip

from qsim.cli.program import main
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.streams.clip import Clip

SHAPE = (5, 8, 11)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    """Return noise of odd size: all pixels move 2 px to the right, depth grows downwards, the last row has none."""
    path = tmp_path_factory.mktemp("preview") / "odd"
    meta = {"shape": list(SHAPE), "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE, "camera": None}
    flow = np.zeros((2, *SHAPE[1:]), np.float32)
    flow[0] = 2.0
    depth = np.repeat(np.linspace(1, 4, SHAPE[1], dtype=np.float32)[:, None], SHAPE[2], axis=1)
    depth[-1] = np.inf
    with ClipWriter(path, meta) as writer:
        for t in range(SHAPE[0]):
            radiance = np.random.default_rng(t).random(SHAPE[1:])
            writer.add(t, radiance, truth={"flow": flow, "depth": depth}, error=0.01)
    assert main(["sense", str(path), "--ppp", "3.25", "--bits", "3", "-o", "mine"]) == 0
    return Clip.open(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a clip, a stream, a restored video, a training curve and an evaluation."""
    top = tmp_path_factory.mktemp("report")
    clip = square_clip(top / "square")
    assert main(["sense", str(clip.path), "--ppp", "3.25", "--bits", "3"]) == 0
    stream = Clip.open(clip.path).stream(Clip.open(clip.path).streams[0])
    np.save(top / "video.npy", np.full(clip.shape, 3.25, np.float32))
    describe_video(top / "video.json", description="moment inverse", source=str(stream.path))
    entry = {"step": 10, "elapsed": 60.0, "psnr_matched": 21.5}
    (top / "history.json").write_text(json.dumps({"settings": {}, "history": [entry, entry | {"elapsed": 120.0}]}))
    interval = {"mean": 20.0, "half_width": 1.0, "scenes": 2}
    line = {"method": "<moment>", "light": "3.25 PPP", "seconds_per_frame": 0.1, "truth_psnr": None}
    line["scores"] = {"psnr": interval, "psnr_matched": interval, "ssim_matched": interval | {"half_width": None}}
    evaluation = {"format": "quiver-evaluation-2", "peak": "white", "table": [line]}
    (top / "evaluation.json").write_text(json.dumps(evaluation))
    (top / "unknown.json").write_text("[1, 2]")
    return top
