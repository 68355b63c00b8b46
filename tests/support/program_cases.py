"""Calls of every public function, with small inputs that reach into the tails, and hosts in which they are made."""

from __future__ import annotations

import asyncio
import contextlib
import pickle
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import synthetic
import tiny_clip

import qsim
import quiver
from qsim.sensor.sensor import Sensor
from qsim.streams.photons import clip_photons

EXPOSURE = 5e-4  # s
KEY = qsim.Key(3, 5, 7)
# From no light to far beyond white: probabilities and their products underflow
LIGHT = np.array([0.0, 5e-324, 1e-300, 1e-12, 0.4, 9.0, 300.0, 1e5, 1e8])
FRAMES = np.resize(np.delete(LIGHT, 1), (2, 8, 9))
SENSORS: dict[str, Sensor] = {
    "QIS": qsim.QIS(0.8, 1.6, 0.2, 3),
    "QIS, quiet": qsim.QIS(0.8, 0.0, 0.02, 2),
    "QIS, 6 bits": qsim.QIS(0.8, 1.6, 3.0, 6, gain=2.0, offset=20.0),
    "planes": qsim.BinarySPAD(0.4, 20.0, 3),
    "counting": qsim.CountingSPAD(0.5, 100.0, 1e-6, 4),
    "paralyzable": qsim.CountingSPAD(0.5, 100.0, 2e-5, 4, paralyzable=True),
    "spikes": qsim.SpikeCamera(0.5, 100.0, 3),
}
OF_LIGHT = ("mean", "variance", "moments", "cdf", "pmf", "log_pmf", "dcdf", "fisher_information", "arrivals")

Call = Callable[[Path], Any]  # of a folder of its own


def calls(shared: Path) -> dict[str, Call]:
    """Return the calls by name; `shared` is a folder with a clip, which `prepare` made."""
    clip = qsim.Clip.open(shared / "clip")
    stream = clip.stream("s")
    found: dict[str, Call] = {}
    for name, sensor in SENSORS.items():
        found |= _of_sensor(name, sensor)
    found |= {
        "expected_photons": lambda _: qsim.expected_photons(1e-320 * np.ones((7, 9)), CAMERA, EXPOSURE),
        "pack, unpack": lambda _: qsim.unpack(qsim.pack(np.arange(8, dtype=np.uint8)[None, None], 3), 8, 3),
        "load_sensor": lambda _: str(qsim.load_sensor("quiver-physical", ppp=3.25)),
        "Clip": lambda _: [clip_photons(clip, 1, 1e-300), clip.flow(0), clip.depth(1), clip.mean_photons],
        "Stream": lambda _: [stream.truth(), np.asarray(stream.codes), stream.sensor.white(stream.exposure)],
        "replay": lambda _: qsim.replay(clip, stream, 1),
        "sense": lambda place: np.asarray(_copy(clip, place).sense("quiver-physical", ppp=3.25).codes),
        "ClipWriter": lambda place: tiny_clip.write(place / "written").info.error_per_frame,
        "score": lambda _: quiver.score(np.full(stream.shape, 1e-30, np.float32), stream),
        "windows": lambda _: quiver.windows(stream, frames=3, crop=4)[0],
        "restore, moment": lambda _: quiver.restore(stream, "moment"),
        "restore, likelihood": lambda _: quiver.restore(stream, "likelihood"),
    }
    return found


def slow_calls(shared: Path) -> dict[str, Call]:
    """Return the calls that calibrate or render, and those of networks; the first compiles kernels."""
    stream = qsim.Clip.open(shared / "clip").stream("s")
    look: dict[str, Any] = {"frames": 2, "height": 12, "width": 16}
    budget = qsim.Budget(samples=2, bounces=2)

    def rendered(place: Path) -> Any:
        made = qsim.render("plain", place / "rendered", budget=budget, **look)
        return [made.radiance(1), made.flow(0), made.info.error_per_frame]

    def planned(_: Path) -> Any:
        from qsim.dataset.scene_rendering import load_scene
        from qsim.rendering.render_settings import RenderSettings

        scene, _read = load_scene("plain", 0, None, RenderSettings(height=12, width=16))
        chosen = qsim.choose_budget(scene, frames=2, psnr=25, denoise=False)
        return [chosen.samples, chosen.bounces, chosen.left_out]

    darks, flats = synthetic.QISCase(frames=6, side=8).stacks(np.random.default_rng(1))
    counted = synthetic.SPADCase(frames=12, side=8)
    return {
        "calibrate_qis": lambda _: qsim.calibrate_qis(darks, flats, bits=8),
        "calibrate_spad": lambda _: counted.calibrate(np.random.default_rng(2))[0],
        "render": rendered,
        "choose_budget": planned,
        "restore, mergenet": lambda _: quiver.restore(stream, "mergenet"),
        "restore, qbp": lambda _: quiver.restore(stream, "qbp"),
        "restore, transform-denoise": lambda _: quiver.restore(stream, "transform-denoise"),
    }


CAMERA = qsim.Camera(**{**tiny_clip.CAMERA, "height": 7, "width": 9})


def prepare(shared: Path) -> None:
    """Write what the calls read."""
    clip = tiny_clip.write(shared / "clip")
    clip.sense("quiver-physical", ppp=3.25, bits=3, name="s")


def _copy(clip: qsim.Clip, place: Path) -> qsim.Clip:
    import shutil

    return qsim.Clip.open(shutil.copytree(clip.path, place / "clip", ignore=shutil.ignore_patterns("streams")))


def _of_sensor(name: str, sensor: Sensor) -> dict[str, Call]:
    levels = 2**sensor.bits
    histograms = np.zeros((3, levels))
    histograms[0, 0] = histograms[1, -1] = 1000
    histograms[2, : levels // 2 + 1] = 5
    found: dict[str, Call] = {}
    for method in OF_LIGHT:
        found[f"{name}.{method}"] = lambda _, method=method: getattr(sensor, method)(LIGHT, EXPOSURE)
    found |= {
        f"{name}.log_likelihood": lambda _: sensor.log_likelihood(np.arange(9) % levels, LIGHT, EXPOSURE),
        f"{name}.maximum_likelihood": lambda _: sensor.maximum_likelihood(histograms, EXPOSURE),
        f"{name}.response": lambda _: _response(sensor),
        f"{name}.sample": lambda _: sensor.sample(FRAMES, EXPOSURE, key=KEY, engine="reference"),
        f"{name}.sample, fast": lambda _: sensor.sample(FRAMES, EXPOSURE, key=KEY),
        f"{name}.sample_packed": lambda _: sensor.sample_packed(FRAMES, EXPOSURE, key=KEY),
    }
    return found


def _response(sensor: Sensor) -> Any:
    response = sensor.response(EXPOSURE)
    return [response, response.invert(np.linspace(0, 2**sensor.bits - 1, 7), 5), response.cap(5)]


# Hosts


def answer(call: Call, place: Path) -> bytes:
    """Return the result of a call as bytes to compare, or the error that it raised."""
    place.mkdir(parents=True)
    try:
        found = call(place)
    except Exception as error:
        found = f"{type(error).__name__}: {error}".replace(str(place), "")
    return pickle.dumps(plain(found))


def plain(value: Any) -> Any:
    """Return a result as bytes, numbers and texts in lists."""
    if hasattr(value, "detach"):
        value = value.detach().numpy()
    if isinstance(value, np.ndarray | np.generic):
        return [str(value.dtype), value.shape, np.ascontiguousarray(value).tobytes()]
    if is_dataclass(value):
        return [(field.name, plain(getattr(value, field.name))) for field in fields(value)]
    if isinstance(value, dict):
        return [(str(key), plain(each)) for key, each in value.items()]
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return repr(value)


def answers(found: dict[str, Call], place: Path) -> dict[str, bytes]:
    """Return the answers of all calls, one after the other."""
    return {name: answer(call, place / str(n)) for n, (name, call) in enumerate(found.items())}


@contextlib.contextmanager
def numpy_raises() -> Iterator[None]:
    """Let NumPy raise."""
    with np.errstate(all="raise"):
        yield


@contextlib.contextmanager
def warnings_are_errors() -> Iterator[None]:
    """Let warnings raise."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@contextlib.contextmanager
def torch_of_doubles() -> Iterator[None]:
    """Let torch make doubles, and compute in 16 bits where it may."""
    import torch

    torch.set_default_dtype(torch.float64)
    try:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextlib.contextmanager
def everything() -> Iterator[None]:
    """Let all of these hold."""
    with numpy_raises(), warnings_are_errors(), torch_of_doubles():
        yield


Made = dict[str, bytes]


def in_place(found: dict[str, Call], place: Path) -> list[Made]:
    """Return the answers in this thread."""
    return [answers(found, place)]


def in_threads(found: dict[str, Call], place: Path) -> list[Made]:
    """Return the answers of four threads that make all calls at the same time, each in an order of its own."""

    def one(thread: int) -> Made:
        order = np.random.default_rng(thread).permutation(list(found))
        with np.errstate(all=("raise", "ignore")[thread % 2]):
            return answers({str(name): found[str(name)] for name in order}, place / str(thread))

    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(one, range(4)))


def in_an_event_loop(found: dict[str, Call], place: Path) -> list[Made]:
    """Return the answers of `asyncio.to_thread`, all calls at once, in the context of the loop."""

    async def everything() -> Made:
        tasks = [asyncio.to_thread(answer, call, place / str(n)) for n, call in enumerate(found.values())]
        return dict(zip(found, await asyncio.gather(*tasks), strict=True))

    return [asyncio.run(everything())]
