"""What the program once computed, it still computes: codes, light, video, scores, calibrations.

A failing test says that results changed. A section is stored again only after a change that was meant, and the commit
says which: `PYTHONPATH=.:tests/support python tests/system/test_unchanged.py --write SECTION ...`. Only names that
survive every move are used: `import qsim`, `quiver.restore`, and the commands.
Methods that search windows of frames are compared where their windows are complete: other frames follow the
treatment of the ends.

data/unchanged.json has texts and checksums (of codes: SHA-256, no code may differ). data/unchanged.npz has numbers, and
the standard errors of fitted ones. tests/support/machines.py states how each kind may differ between machines.

Rendered light is the same for any number of threads, and was only ever compared on the versions of NumPy, Mitsuba,
Dr.Jit and LLVM that data/unchanged.json names: with others, sections that render are skipped.
Losses and networks ran on one thread of a CPU.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import machines
import numpy as np
import pytest
from machines import ErrorsOfLight, Fits, Rendered, Sums

import qsim.cli
import quiver.cli
from qsim import QIS, BinarySPAD, Camera, Clip, ClipWriter, CountingSPAD, Dataset, Key, Sensor, descriptions
from qsim.dataset.dataset import DatasetInfo
from qsim.dataset.series import Series
from quiver import restore

DATA = Path(__file__).parents[1] / "data"
Array = np.ndarray
RESPONSE = 1e-3  # relative error of a fitted response, at least


Result = str | machines.Result
Results = Iterator[tuple[str, Result]]  # what it is, and what came out
_SECTIONS: dict[str, tuple[Callable[[Path], Results], bool]] = {}  # name -> (maker in an empty folder, renders)
_SLOW = []


def section(*, renders: bool = False, slow: bool = False) -> Callable[[Callable[[Path], Results]], Any]:
    """Registers a maker of results: a function of an empty folder."""

    def register(make: Callable[[Path], Results]) -> Callable[[Path], Results]:
        _SECTIONS[make.__name__] = make, renders
        _SLOW.extend([make.__name__] if slow else [])
        return make

    return register


# Helpers


def checksum(codes: Array) -> str:
    """SHA-256 of type, shape and bytes, 32 digits of it."""
    codes = np.ascontiguousarray(codes)
    return hashlib.sha256(f"{codes.dtype} {codes.shape} ".encode() + codes.tobytes()).hexdigest()[:32]


def run(main: Callable[[list[str]], int], line: str, *more: object) -> dict[str, Any]:
    """The JSON object that a command prints; `more` words are not split at spaces."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()) as errors:
        code = main([*line.split(), *map(str, more), "--json"])
    assert code == 0, f"{line}: {errors.getvalue()}"
    return json.loads(out.getvalue())


def numbers(tree: Any) -> Iterator[float]:
    """All numbers of a JSON object in the order of its sorted keys; time and memory are left out."""
    if isinstance(tree, dict):
        for key in sorted(tree):
            if key not in ("seconds_per_frame", "peak_bytes"):
                yield from numbers(tree[key])
    elif isinstance(tree, list):
        for item in tree:
            yield from numbers(item)
    elif isinstance(tree, int | float) and not isinstance(tree, bool):
        yield float(tree)


def moving(frames: int, height: int, width: int, seed: int) -> Array:
    """Radiance [T, H, W] from whole numbers alone: blocks and stripes in 64ths, and a bright square that moves."""
    t, y, x = np.mgrid[:frames, :height, :width]
    right = x - 2 * t + 5 * seed
    down = y - t + 3 * seed
    light = 16 + (7 * (right // 3) + 5 * (down // 4)) % 64 + 8 * ((right + 2 * down) % 5)
    return (light + 96 * ((right % width < width // 4) & (y % height > height // 2))) / 64


def write_clip(path: Path, frames: int, height: int, width: int, seed: int = 0) -> Path:
    """A clip of the light above, with flow."""
    camera = Camera(8e-3, 2.8, 1.1e-6, height, width)
    meta = {"shape": [frames, height, width], "frame_rate": 2000.0, "exposure": 5e-4, "camera": asdict(camera)}
    meta |= {"radiance_unit": "W m^-2 sr^-1", "scene": {"family": "moving", "seed": seed}}
    flow = np.stack([np.full((height, width), 2.0), np.full((height, width), 1.0)])
    truth = {"flow": flow, "flow_back": -flow, "valid": np.ones((height, width), bool)}
    with ClipWriter(path, meta) as writer:
        for t, frame in enumerate(moving(frames, height, width, seed)):
            writer.add(t, frame, truth=truth, error=0.01)
    return path


def write_dataset(path: Path) -> Path:
    """Two clips to train on and one to validate, as `qsim generate` lists them."""
    series = []
    (path / "jobs").mkdir(parents=True)
    for seed, split in enumerate(("train", "train", "val")):
        write_clip(path / "clips" / f"moving_{seed:04d}", 13, 36, 44, seed)
        (path / "jobs" / f"moving_{seed:04d}.json").touch()
        series.append(Series(stem="moving", seeds=seed, split=split, digest="0" * 64))
    descriptions.write(path / "dataset.json", DatasetInfo(name="moving", scenes=tuple(series)))
    return path


# Sensors

SENSORS: tuple[Sensor, ...] = (
    *(QIS(0.8, 1.6, 0.2, bits) for bits in range(1, 9)),
    *(QIS(0.8, 1.6, 0.2, bits, gain=0.5 * (2**bits - 1) / 3.25) for bits in (1, 2, 3, 5, 7)),
    QIS(0.5, 100.0, 0.0, 4),
    QIS(1.0, 0.0, 0.0, 3, gain=0.5, offset=0.5),
    QIS(0.9, 4000.0, 0.7, 6, gain=2.5, offset=3.25, full_well=17.5),
    QIS(0.6, 20.0, 0.15, 8, gain=8.0, offset=40.0, full_well=24.0),
    QIS(0.8, 1.6, 2.5, 8, gain=0.25, offset=5.0),
    QIS(0.8, 1.6, 5.1, 12, offset=32.0),
    QIS(0.35, 50.0, 1.5, 16, gain=30.0, offset=100.0, full_well=2000.0),
    *(BinarySPAD(0.4, 25.0, bits) for bits in (1, 2, 3, 5, 8, 9, 12)),
    BinarySPAD(1.0, 0.0, 3),
    BinarySPAD(0.105, 2e4, 4),
    CountingSPAD(0.35, 25.0, 3.5e-8, 8),
    CountingSPAD(0.5, 0.0, 0.0, 4),
    *(CountingSPAD(0.5, 200.0, 2e-5, bits) for bits in (1, 3, 5, 8)),
    CountingSPAD(0.5, 200.0, 2e-6, 12),
    CountingSPAD(0.9, 0.0, 4e-4, 2),
    *(CountingSPAD(0.5, 200.0, dead, bits, True) for dead, bits in ((2e-5, 3), (2e-5, 6), (2e-6, 8), (2e-6, 12))),
    CountingSPAD(0.9, 10.0, 3e-4, 3, True),
    CountingSPAD(0.5, 0.0, 6e-4, 2, True),
)
KEYS = (Key(0, 0), Key(3, 2**62 + 1, 5, 2), Key(-7, 12345, 2**24 - 3), Key(2**40 + 1, -9, 1000, 77))
ORIGINS = ((0, 0), (3, 5), (239, 318), (1001, 2))


def light_for(sensor: Sensor) -> Array:
    """Photons [3, 13, 37]: none, then from 1/50 of white to twice white."""
    ramp = np.linspace(0.0, 1.0, 13 * 37).reshape(13, 37)
    return np.stack([ramp, ramp**3, ramp[::-1]]) * 2 * min(sensor.white(5e-4), 400.0)


def _codes(engine: str) -> Results:
    for i, sensor in enumerate(SENSORS):
        key = KEYS[i % len(KEYS)]
        origin = ORIGINS[i // 2 % len(ORIGINS)]
        photons = light_for(sensor)
        codes = sensor.sample(photons, 5e-4, key=key, origin=origin, engine=engine)
        yield f"{i} {sensor!r}", checksum(codes)
        if i % 4 == 0:
            yield f"{i} packed", checksum(sensor.sample_packed(photons, 5e-4, key=key, origin=origin, engine=engine))
            cut = sensor.sample(photons[0, 4:9, 7:20], 5e-4, key=key, origin=(origin[0] + 4, origin[1] + 7))
            yield f"{i} crop", checksum(cut)
        if isinstance(sensor, BinarySPAD) and sensor.bits <= 5:
            group = np.resize(photons / sensor.planes, (2 * sensor.planes, 13, 37))
            late = key.at(2**32 // sensor.planes - 9)
            planes = sensor.sample_planes(group, 5e-4 / sensor.planes, key=late, engine=engine)
            yield f"{i} planes", checksum(planes)


@section()
def codes_of_the_reference(folder: Path) -> Results:
    yield from _codes("reference")


@section()
def codes_of_the_compiled_engine(folder: Path) -> Results:
    yield from _codes("fast")


@section()
def laws_of_sensors(folder: Path) -> Results:
    """Mean, variance, information, likelihood and estimates at a few lights."""
    for i, sensor in enumerate(SENSORS):
        if sensor.bits > 8:
            continue
        light = np.array([0.02, 0.3, 0.9, 1.7]) * min(sensor.white(5e-4), 50.0)
        laws = [sensor.mean(light, 5e-4), sensor.variance(light, 5e-4), sensor.fisher_information(light, 5e-4)]
        laws.append(sensor.log_likelihood(np.full(4, sensor.levels // 2), light, 5e-4))
        terms = machines.LARGEST_EXPONENT + sensor.levels
        yield f"{i} laws", Sums(np.array(laws), terms, of="each")
        if sensor.bits <= 4:
            codes = sensor.sample(np.repeat(light[1:3], 40).reshape(2, 40), 5e-4, key=Key(6, i), engine="reference")
            histograms = np.stack([np.bincount(row, minlength=sensor.levels) for row in codes])
            found = sensor.maximum_likelihood(histograms, 5e-4)
            estimates = np.array([found.photons, found.lower, found.upper])
            errors = np.tile(machines.standard_errors(*estimates), (3, 1))
            yield f"{i} estimate", Fits(estimates, errors, terms)


# Streams

DEVICES = (
    "quiver-physical",
    "quiver-paper",
    "quiver-published",
    "cmos-5.1e",
    "spad-320x240",
    "qis-ma2017",
    "megax-a",
    "megax-b",
    "spad512s",
    "spcm20a",
)
DEFECTS = {
    "qis": "device_seed = 7\nprnu = 0.05\ndead = 0.02\noffset = 0.2\nread_noise = 0.1\n"
    "dark = { spread = 0.18, hot_share = 0.1, hot_from = 3.0, hot_to = 400.0, tail = 0.67 }",
    "measured": 'dark_map = "dark.npy"\ngain_map = "gain.npy"\ndead_map = "dead.npy"',
    "neighbours": "crosstalk = 0.02\nprnu = 0.03",
    "afterpulses": "afterpulse = 0.05\ncrosstalk = 0.01\ndead = 0.01",
    "counting": "afterpulse = 0.05\nafterpulse_delay = 4e-6\ncarry_dead_time = true\nprnu = 0.02",
}
COUNTER = '[sensor]\nmodel = "CountingSPAD"\npde = 0.5\ndark_count_rate = 200.0\ndead_time = 2e-5\nbits = 4\n'


def _stored(clip: Path, name: str, line: str, *more: object) -> Results:
    """What `qsim sense` stores and says of the light, for each light level."""
    for said in run(qsim.cli.main, "sense -q", clip, *line.split(), *more)["streams"]:
        stream = Clip.open(clip).stream(said["stream"])
        yield f"{name} {said['stream']}", checksum(stream.packed)
        light = np.array([stream.photons_factor, said["ppp"]])
        yield f"{name} {said['stream']} light", Sums(light, int(np.prod(stream.shape)), of="each")


@section()
def streams_of_devices(folder: Path) -> Results:
    clip = write_clip(folder / "clip", 15, 11, 19)
    for device in DEVICES:
        yield from _stored(clip, "device", f"--sensor {device} --ppp 0.5,3.25,26")
    for bits in range(1, 8):
        yield from _stored(clip, "bits", f"--sensor quiver-physical --bits {bits} --ppp 1,9.75 --seed 3")
    for bits in (2, 3, 4):
        yield from _stored(clip, "summed", f"--sensor megax-b --bits {bits} --ppp 20")
    yield from _stored(clip, "group", "--sensor spad-320x240 --bits 3 --ppp 4 --group -o group")
    yield from _stored(clip, "diffraction", "--sensor quiver-paper --ppp 3.25 --diffraction -o diffraction")
    yield from _stored(clip, "lux", "--sensor spad512s --lux 2 -o lux")
    yield from _stored(clip, "slices", "--sensor spcm20a --ppp 30 --slices 3 -o slices")


@section()
def streams_with_defects(folder: Path) -> Results:
    clip = write_clip(folder / "clip", 6, 11, 19, seed=2)
    grid = np.arange(11 * 19, dtype=float).reshape(11, 19)
    np.save(folder / "dark.npy", 5 + grid % 17)
    np.save(folder / "gain.npy", 1 + (grid % 7 - 3) / 20)
    np.save(folder / "dead.npy", grid % 31 == 4)
    for name, table in DEFECTS.items():
        (folder / f"{name}.toml").write_text(f"[defects]\n{table}\n")
    (folder / "paralyzable.toml").write_text(f"{COUNTER}paralyzable = true\n")
    (folder / "carried.toml").write_text(f"{COUNTER}[defects]\n{DEFECTS['counting']}\n")
    for name, line in (
        ("qis", "--sensor quiver-physical --ppp 3.25"),
        ("qis", "--sensor quiver-published --bits 5 --ppp 9.75"),
        ("measured", "--sensor spad512s --bits 3 --ppp 5"),
        ("measured", "--sensor quiver-paper --bits 2 --ppp 1"),
        ("neighbours", "--sensor megax-a --bits 2 --ppp 20"),
        ("neighbours", "--sensor spad512s --ppp 1"),
        ("afterpulses", "--sensor spad512s --ppp 1"),
        ("afterpulses", "--sensor megax-b --bits 3 --ppp 20"),
        ("counting", "--sensor spcm20a --ppp 200"),
    ):
        made = f"{name} {line}".replace(" ", "_").replace("-", "")
        yield from _stored(clip, line, f"{line} -o {made}", "--defects", folder / f"{name}.toml")
    for name in ("paralyzable", "carried"):
        yield from _stored(clip, name, "--ppp 5,40", "--sensor", folder / f"{name}.toml")
        yield from _stored(clip, name, f"--ppp 20 --slices 3 -o {name}_slices", "--sensor", folder / f"{name}.toml")


# Rendering


def _rendered(path: Path, line: str) -> Results:
    """A clip's light, how exact it is, and its ground truth, from the command that renders it."""
    run(qsim.cli.main, "render -q", *line.split(), "-o", path)
    yield from _light(Clip.open(path), line)


def _light(clip: Clip, line: str) -> Results:
    budget = {key: getattr(clip.info.render, key) for key in ("samples", "bounces", "denoise")}
    for t in range(len(clip)):
        cut = slice(None, None, -(-clip.shape[1] // 32)), slice(None, None, -(-clip.shape[2] // 32))
        yield f"{line}, radiance {t}", Rendered(clip.radiance(t)[cut], **budget)
        if t == 0:
            yield f"{line}, sharp", Rendered(clip.sharp(t)[cut], **budget)
            truth = np.stack([*clip.flow(t), *clip.flow_back(t)])[:, 1::3, 1::3]
            yield f"{line}, flow", Sums(truth, RAY_TERMS, np.float32, of=float(max(clip.shape)))
            yield f"{line}, depth", Sums(clip.depth(t)[1::2, 1::2], RAY_TERMS, np.float32)
            yield f"{line}, bodies", checksum(clip.body_id(t).astype(np.int16))
            yield f"{line}, valid", checksum(clip.valid(t))
    means = np.array([clip.mean_radiance, clip.mean_photons])
    yield f"{line}, means", Sums(means, budget["samples"] * budget["bounces"], np.float32, of="each")
    errors = np.array([*clip.info.error_per_frame, clip.info.psnr_of_truth])
    yield f"{line}, errors", ErrorsOfLight(errors, Rendered(clip.radiance(0), **budget))
    yield f"{line}, budget", json.dumps(list(budget.values()))


RAY_TERMS = 16  # a product of two matrices, a hit and a projection, in single precision
SMALL = "--height 24 --width 32 --frames 2 --psnr 30"


@section(renders=True)
def clip_of_a_fan(folder: Path) -> Results:
    yield from _rendered(folder / "clip", f"fan {SMALL} --speed 4 --seed 1")


@section(renders=True, slow=True)
def clips_of_other_families(folder: Path) -> Results:
    for i, line in enumerate((f"gears {SMALL} --shutter 0.5", f"glass {SMALL}", f"flag {SMALL} --speed 2 --ppp 10")):
        yield from _rendered(folder / str(i), line)


@section(renders=True, slow=True)
def clip_that_is_denoised(folder: Path) -> Results:
    yield from _rendered(folder / "clip", "room --height 96 --width 96 --frames 1 --psnr 40")


RECIPE = """
[recipe]
name = "tiny"
frames = 2
height = 12
width = 16
frame_rate = 2000.0
psnr = 25.0
seed = 4
[[scenes]]
family = "fan"
seeds = [1]
speed = 4.0
split = "train"
[[scenes]]
family = "drums"
seeds = [0]
split = "test"
[[streams]]
sensor = "quiver-physical"
bits = [1, 3]
ppp = 3.25
[[streams]]
sensor = "spad512s"
bits = 2
ppp = 5.0
"""


@section(renders=True, slow=True)
def data_set_of_a_recipe(folder: Path) -> Results:
    (folder / "tiny.toml").write_text(RECIPE)
    run(qsim.cli.main, "generate -q", folder / "tiny.toml", "-o", folder / "tiny")
    data = Dataset.open(folder / "tiny")
    for name in data.names():
        record = json.loads((folder / "tiny" / "jobs" / f"{name}.json").read_text())
        clip = Clip.open(folder / "tiny" / "clips" / name)
        record = {key: record[key] for key in ("name", "split")} | {"streams": sorted(record["streams"])}
        yield f"record of {name}", json.dumps(record, sort_keys=True)
        yield from _light(clip, name)


# Restoring

PIXELWISE = ("naive", "moment", "likelihood")
BM3D = ("transform-denoise", "transform-denoise-published", "qbp-bm3d")
LIGHTS = (
    "--sensor quiver-physical --bits 3 --ppp 3.25",
    "--sensor spad-320x240 --bits 3 --ppp 4.9",
    "--sensor spad-320x240 --bits 1 --ppp 0.7",
    "--sensor spcm20a --bits 4 --ppp 6",
)


VIDEO_TERMS = 64  # a value sums up to 13 frames of 4 bilinear weights, and passes a dozen steps of tables
CLOSED_FORM_TERMS = 16


def _video(name: str, video: Array, white: float) -> Results:
    """Some pixels of the first, a middle and the last frame, and each frame's mean and spread."""
    assert video.dtype == np.float32
    some = video[[0, len(video) // 2, -1], 1::3, ::3]
    yield f"{name}, pixels", Sums(some, VIDEO_TERMS, np.float32)
    frames = np.stack([video.mean((1, 2), float), video.std((1, 2), float)])
    yield f"{name}, frames", Sums(frames, VIDEO_TERMS, np.float32)
    yield f"{name}, white", Sums(np.array([white]), CLOSED_FORM_TERMS)


def _restored(clip: Path, out: Path, name: str, line: str, frames: slice = slice(None)) -> Results:
    run(quiver.cli.main, "restore -q", clip, "-o", out, *line.split())
    yield from _video(name, np.load(out)[frames], json.loads(out.with_suffix(".json").read_text())["white"])


@section()
def video_of_classical_methods(folder: Path) -> Results:
    """Of QBP the frames whose windows are complete."""
    clip = write_clip(folder / "clip", 13, 26, 35)
    for i, light in enumerate(LIGHTS):
        for method in (*PIXELWISE, "qbp"):
            if i == 0 or method == "moment":
                yield from _classical(clip, folder / f"{method}{i}.npy", light, method)


@section(slow=True)
def video_of_searches(folder: Path) -> Results:
    """QBP as published, and of single bits: the rest of its settings, a quarter of a minute of processor time."""
    clip = write_clip(folder / "clip", 13, 26, 35)
    for light, method in ((LIGHTS[0], "qbp-published"), (LIGHTS[2], "qbp")):
        yield from _classical(clip, folder / f"{method}.npy", light, method)


def _classical(clip: Path, out: Path, light: str, method: str) -> Results:
    line = f"{light} --method {method}"
    yield from _restored(clip, out, line, line, slice(5, 8) if method.startswith("qbp") else slice(None))


@section()
def video_of_methods_with_bm3d(folder: Path) -> Results:
    """Of the frames whose windows are complete."""
    clip = write_clip(folder / "clip", 13, 26, 35)
    for i, light in enumerate(LIGHTS[:2]):
        for method in BM3D:
            if i == ("published" in method):  # the arcsine is for sums of binary samples
                line = f"{light} --method {method}"
                yield from _restored(clip, folder / f"{method}{i}.npy", line, line, slice(5, 8))


@section()
def video_of_a_notebook(folder: Path) -> Results:
    """Codes in an array, and a packed photon cube on the command line."""
    light = moving(13, 18, 21, 1) * 2
    for sensor in (QIS(0.8, 1.6, 0.2, 2), CountingSPAD(0.5, 200.0, 2e-5, 4, True)):
        codes = sensor.sample(light, 5e-4, key=Key(1, 2))
        video = restore(codes, "moment", sensor=sensor, exposure=5e-4)
        yield from _video(f"array of {sensor!r}", video, sensor.white(5e-4))
    cube = BinarySPAD(1.0, 0.0, 1).sample_packed(np.repeat(light, 3, axis=0) / 5, 1e-4, key=Key(1, 2))
    np.save(folder / "cube.npy", cube)
    line = "--width 21 --planes 3 --sensor spad-320x240 --bits 2 --frame-rate 9000 --method moment"
    yield from _restored(folder / "cube.npy", folder / "out.npy", "photon cube", line)


# Training and comparing


def _trained(data: Path, run_folder: Path, line: str) -> Results:
    fixed = (
        "--sensor quiver-physical --bits 3 --ppp 3.25 --validate-every 1 --threads 1 --device cpu --precision float32"
    )
    run(quiver.cli.main, "train -q", data, "-o", run_folder, *fixed.split(), *line.split())
    history = json.loads((run_folder / "history.json").read_text())["history"]
    for key in ("loss", "psnr", "psnr_matched"):
        yield f"{line}, {key}", Sums(np.array([entry[key] for entry in history]), VIDEO_TERMS, np.float32, of="each")
    clip = data / "clips" / "moving_0002"
    video = f"{LIGHTS[0]} --method {run_folder} --threads 1"
    yield from _restored(clip, run_folder / "restored.npy", f"{line}, restored", video)


@section(slow=True)
def training_of_other_presets(folder: Path) -> Results:
    data = write_dataset(folder / "data")
    unet = "--preset unet --protocol control --steps 3 --crop 16 --batch 2 --loss l1"
    yield from _trained(data, folder / "unet", unet)
    small = "--preset quiver-s --protocol published --steps 1 --crop 32 --batch 1 --optimiser adam --seed 2"
    yield from _trained(data, folder / "quiver-s", small)


@section()
def scores_of_an_evaluation(folder: Path) -> Results:
    clip = write_clip(folder / "clip", 12, 26, 35)
    yield from _scores(clip, folder, "published", "--methods likelihood --ppp 3.25 --bits 3 --published")
    yield from _scores(clip, folder, "planes", "--methods moment --ppp 5 --bits 3 --sensor spad512s --peak 10")


@section(slow=True)
def scores_of_two_lights(folder: Path) -> Results:
    clip = write_clip(folder / "clip", 12, 26, 35)
    yield from _scores(clip, folder, "two lights", "--methods naive,moment:5,qbp:7 --ppp 3.25,9.75 --bits 3")


def _scores(clip: Path, folder: Path, name: str, line: str) -> Results:
    found = run(quiver.cli.main, "evaluate -q --split all --threads 1", clip, "-o", folder / name, *line.split())
    for row in found["rows"]:
        scores = [*numbers(row["score"]), *numbers(row["motion_squares"]), row["peak"], row["truth_psnr"]]
        yield f"{name} {row['method']} {row['light']}", Sums(np.array(scores), VIDEO_TERMS, np.float32, of="each")


@section()
def scores_of_a_static_object(folder: Path) -> Results:
    light = np.repeat(moving(1, 26, 35, 3), 60, axis=0)
    np.save(folder / "counts.npy", QIS(1.0, 0.0, 0.0, 8).sample(light, 5e-4, key=Key(4, 4)))
    found = run(
        quiver.cli.main, "evaluate -q --methods moment,naive --frames 7 --splits 2 --static", folder / "counts.npy"
    )
    yield "static", Sums(np.array(list(numbers(found))), 8, np.float32, of="each")  # 7 frames, and the splits


# Calibrating, and what a bit depth costs


def _taken(folder: Path, sensor: Sensor, name: str, photons: Iterable[tuple[float, float]], frames: int) -> list[str]:
    """Stacks of even light with 4 % of fixed pattern: the options that name file, exposure and light."""
    words = []
    pattern = 1 + 0.04 * ((np.arange(15 * 17) * 29 % 41).reshape(15, 17) / 20 - 1)
    for i, (exposure, light) in enumerate(photons):
        codes = sensor.sample(np.broadcast_to(light * pattern, (frames, 15, 17)), exposure, key=Key(i, 11))
        np.save(folder / f"{name}{i}.npy", codes)
        words += ["--flat" if light else "--dark", str(folder / f"{name}{i}.npy"), repr(exposure)]
        words += [repr(light)] if light else []
    return words


def _calibrated(line: str, *words: object) -> Fits:
    """Values and the ends of their intervals, in the order of their names, and the p-value of the fit."""
    found = run(qsim.cli.main, f"calibrate -q {line}", *words)
    table = [found["values"][name] for name in sorted(found["values"])]
    rows = np.array([[row[key] for row in table] for key in ("value", "low", "high")], float)  # null: not a number
    # a description of the recording, as its shading, has no interval, but follows the fitted response of the sensor
    own = machines.standard_errors(*rows)
    own = np.where(own > 0, own, RESPONSE * np.abs(rows[0]))
    errors = np.append(np.tile(own, 3), machines.P_VALUE_ERROR)
    return Fits(np.append(rows, np.array(found["p_value"], float)), errors, CLOSED_FORM_TERMS)


@section()
def calibrations(folder: Path) -> Results:
    lit = ((1e-3, 0.0), (5e-2, 0.0), (1e-3, 0.7), (1e-3, 2.5), (1e-3, 7.0))
    cases: dict[str, tuple[Sensor, str, int]] = {
        "qis": (QIS(0.8, 20.0, 0.25, 8, gain=8.0, offset=40.0), "--bits 8", 20),
        "planes": (BinarySPAD(0.4, 20.0, 1), "--model spad --bits 1", 60),
        "counts": (CountingSPAD(0.4, 20.0, 5e-5, 6), "--model spad --bits 6", 30),
        "paralyzable": (CountingSPAD(0.4, 20.0, 5e-5, 6, True), "--model spad --bits 6 --paralyzable", 30),
        "poisson": (CountingSPAD(0.4, 20.0, 0.0, 6), "--model spad --bits 6 --ignore-dead-time", 30),
    }
    for name, (sensor, line, frames) in cases.items():
        words = _taken(folder, sensor, name, lit, frames)
        yield name, _calibrated(line, *words, "-o", folder / f"{name}.toml")
    light = np.broadcast_to(np.linspace(1.0, 30.0, 15 * 17).reshape(15, 17), (80, 15, 17))
    np.save(folder / "static.npy", CountingSPAD(0.5, 0.0, 3e-5, 8).sample(light, 1e-3, key=Key(1, 1)))
    words = ["--static", folder / "static.npy", "1e-3", "-o", folder / "static.toml"]
    yield "static", _calibrated("--bits 8", *words)


@section()
def tables_of_bit_depths(folder: Path) -> Results:
    for line in ("", "--size 120x160 --base-fps 24000 --read-noise 0.35 --bits 1,2,4,8 --motion 800"):
        found = run(qsim.cli.main, f"tradeoff --table {line}")
        yield f"table {line}", Sums(np.array(list(numbers(found))), CLOSED_FORM_TERMS, of="each")


# Storing and comparing


@functools.cache
def software() -> dict[str, str]:
    """Versions that rendered light depends on."""
    with tempfile.TemporaryDirectory() as folder:
        about = Clip.open(write_clip(Path(folder) / "clip", 1, 4, 4)).info.software
    doctor = run(qsim.cli.main, "doctor")
    engine = f"{doctor['reason'].split(',')[0]}, {'with' if doctor['extras']['denoise'] else 'without'} denoiser"
    return {key: about[key] for key in ("numpy", "mitsuba", "drjit")} | {"engine": engine}


ERRORS = " +- "  # ends the name of the standard errors of fitted values


def made(name: str, folder: Path) -> dict[str, Result]:
    """The results of a section by name, made in an empty folder."""
    return {without(folder, key): result for key, result in _SECTIONS[name][0](folder)}


def write(names: Iterable[str]) -> None:
    """Stores what this program computes in some sections; the others stay."""
    software_then, texts, arrays = stored()
    for name in names:
        texts.pop(name, None)
        arrays = {key: array for key, array in arrays.items() if not key.startswith(f"{name}: ")}
        with tempfile.TemporaryDirectory() as folder:
            for key, result in made(name, Path(folder)).items():
                if isinstance(result, str):
                    texts.setdefault(name, {})[key] = result
                    continue
                arrays[f"{name}: {key}"] = np.asarray(result.values)
                if isinstance(result, Fits):
                    arrays[f"{name}: {key}{ERRORS}"] = np.asarray(result.errors)
        if _SECTIONS[name][1] and software() != software_then:
            sys.exit(f"{name} renders, and was stored with {software_then}; this is {software()}")
    made_now = {"software": software_then, "texts": texts}
    (DATA / "unchanged.json").write_text(json.dumps(made_now, indent=0, sort_keys=True) + "\n")
    np.savez_compressed(DATA / "unchanged.npz", keys=np.array(list(arrays)), **_packed(arrays))


def _packed(arrays: dict[str, Array]) -> dict[str, Array]:
    """All arrays in one of each type, for the size of the file, and their shapes."""
    kinds = np.array([a.dtype.name for a in arrays.values()])
    joined = {kind: np.concatenate([a.ravel() for a in arrays.values() if a.dtype.name == kind]) for kind in {*kinds}}
    return joined | {"kinds": kinds, "shapes": np.array([json.dumps(a.shape) for a in arrays.values()])}


def without(folder: object, text: str) -> str:
    """A name without the folder that it was made in."""
    return text.replace(f"{folder}/", "")


@functools.cache
def stored() -> tuple[dict[str, str], dict[str, dict[str, str]], dict[str, Array]]:
    """(software, texts by section, arrays by section and name)"""
    made = json.loads((DATA / "unchanged.json").read_text())
    with np.load(DATA / "unchanged.npz") as file:
        left = {kind: file[kind] for kind in {*file["kinds"].tolist()}}
        arrays = {}
        for key, kind, shape in zip(*(file[name].tolist() for name in ("keys", "kinds", "shapes")), strict=True):
            size = int(np.prod(json.loads(shape)))
            arrays[key] = left[kind][:size].reshape(json.loads(shape))
            left[kind] = left[kind][size:]
    return made["software"], made["texts"], arrays


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in _SLOW else []) for name in _SECTIONS]
)
def test_results_are_those_stored(name, tmp_path):
    made_with, texts, arrays = stored()
    wanted: dict[str, Any] = dict(texts.get(name, {}))
    wanted |= {key.removeprefix(f"{name}: "): a for key, a in arrays.items() if key.startswith(f"{name}: ")}
    found = made(name, tmp_path)
    assert sorted(found) == sorted(key for key in wanted if not key.endswith(ERRORS))
    other = _SECTIONS[name][1] and software() != made_with
    wrong = {}
    for key, result in found.items():
        if other:
            continue
        if isinstance(result, str):
            if result != wanted[key]:
                wrong[key] = f"{result} instead of {wanted[key]}"
        elif (words := machines.difference(result, wanted[key], wanted.get(f"{key}{ERRORS}"))) is not None:
            wrong[key] = words
    assert not wrong
    if other:
        pytest.skip(f"rendered with {software()}, stored with {made_with}")


if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"
    if sys.argv[1:2] != ["--write"] or not set(sys.argv[2:]) <= set(_SECTIONS) or not sys.argv[2:]:
        sys.exit(f"usage: python tests/system/test_unchanged.py --write SECTION ...; sections: {' '.join(_SECTIONS)}")
    write(sys.argv[2:])
