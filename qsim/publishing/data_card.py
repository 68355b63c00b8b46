"""Writes the data card of a published set: README.md with its contents, pictures, light, motion and licences.

Its head is the YAML by which the Hugging Face Hub and the package datasets find the splits of a set in Parquet.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
from numpy import ndarray as Array

from qsim import colour
from qsim.files import VERSION
from qsim.publishing.contents import Sample, png
from qsim.publishing.record import MODULES, SetInfo
from qsim.publishing.statistics import Statistics
from qsim.sensor import packing
from qsim.streams.stream_info import StreamInfo

SIZES = (("n<1K", 10**3), ("1K<n<10K", 10**4), ("10K<n<100K", 10**5), ("100K<n<1M", 10**6), ("1M<n<10M", 10**7))
FIELDS = {
    "radiance": "float16 [T, H, W], mean over the exposure; [T, 3, H, W] of a colour clip",
    "sharp": "float16, the same at mid-exposure, of the frames for which it differs",
    "flow": "float32 [T, 2, H, W] px, right and down, to the next frame",
    "flow_back": "float32 [T, 2, H, W] px, to the previous frame",
    "valid": "bool [T, H, W], False where a point is hidden in the next frame",
    "depth": "float32 [T, H, W] m along the optical axis; inf where no body is",
    "body_id": "int32 [T, H, W]; -1 where no body is",
    "saturated": "bool [T, H, W], True where light is a lower bound, of the frames with such pixels",
    "codes": "uint8 or (above 8 bits) uint16 [N, H, W], codes of the sensor; packed: uint8 [N, H, ceil(W bits / 8)]",
    "truth": "float32 [N, H, W], sharp photons per pixel and code; [N, 3, H, W] of a colour clip",
}
LOADING = {
    "webdataset": """import webdataset

for clip in webdataset.WebDataset("shards/{split}-00000.tar", shardshuffle=False).decode():
    print(clip["__key__"], clip["json"]["clip"], clip["{field}.npy"].shape)""",
    "parquet": """import io

import numpy
from datasets import load_dataset

clips = load_dataset(".", split="{split}")  # this folder, or its name on the Hub
print(numpy.load(io.BytesIO(clips[0]["{field}"])).shape)""",
    "hdf5": """import h5py
import json

with h5py.File("shards/{split}-00000.h5") as shard:
    for clip in shard.values():
        print(json.loads(clip["description"][()])["clip"], clip["{field}"].shape)""",
    "zarr": """import zarr

shard = zarr.open_group(zarr.storage.ZipStore("shards/{split}-00000.zarr.zip", mode="r"), mode="r")
for key, clip in shard.groups():
    print(key, clip.attrs["description"]["clip"], clip["{field}"].shape)""",
}
NAMES_IN_FORMAT = {
    "webdataset": (
        "a member `KEY.FIELD.npy`; ground truth is `KEY.FIELD.npy.gz`, which webdataset unpacks, and the description "
        "`KEY.json`"
    ),
    "parquet": "a column, the bytes of a .npy file; the description is the column `description`, JSON",
    "hdf5": "an array `/KEY/FIELD`; the description is `/KEY/description`, JSON",
    "zarr": "an array `KEY/FIELD` in the zip; the description is the attribute `description` of the group `KEY`",
}
HEIGHT = 160  # px of a picture, at least


def text(info: SetInfo, totals: Mapping[str, Statistics], pictures: Mapping[str, str], licences: Sequence[str]) -> str:
    """Return the card, in Markdown."""
    whole = sum(totals.values(), Statistics())
    parts = [_head(info, whole.clips), f"# {info.name}", _summary(info, whole)]
    parts += [f"![{clip}: radiance, codes, flow, depth, as far as there]({name})" for clip, name in pictures.items()]
    parts += ["## Contents", _counts(info, totals), "## Loading", _loading(info), _fields(info)]
    parts += ["## Light and motion", _light(totals)]
    if whole.sensors:
        parts += ["## Sensors", _sensors(whole, info)]
    parts += ["## Licences", _licences(info, whole, licences)]
    parts += [f"Written by qsim {VERSION}. `croissant.json` lists every file with its SHA-256."]
    return "\n\n".join(parts) + "\n"


def _head(info: SetInfo, clips: int) -> str:
    """Return the YAML at the top; JSON strings are valid YAML."""
    size = next((name for name, most in SIZES if clips < most), "n>10M")
    lines = ["---", f"pretty_name: {json.dumps(info.name)}"]
    lines += [f"license: {json.dumps(info.licence.lower() if info.licence else 'other')}"]
    lines += [f"size_categories: [{json.dumps(size)}]", 'task_categories: ["image-to-image"]']
    lines += ['tags: ["quanta-image-sensor", "spad", "video", "optical-flow"]']
    if info.to in ("parquet", "webdataset"):
        suffix = MODULES[info.to].SUFFIX
        lines += ["configs:", "- config_name: default", "  data_files:"]
        for split in info.shards:
            lines += [f"  - split: {split}", f'    path: "shards/{split}-*.{suffix}"']
    return "\n".join([*lines, "---"])


def _summary(info: SetInfo, whole: Statistics) -> str:
    """Return one sentence on the set."""
    codes = f", seen by {len(info.streams)} sensor setting{'s' * (len(info.streams) > 1)}" if info.streams else ""
    return (
        f"{whole.clips} clip{'s' * (whole.clips != 1)} of moving scenes, {whole.frames} frames at "
        f"{rates(whole)} per second, with ground truth{codes}."
    )


def rates(found: Statistics) -> str:
    """Return the frame rates of clips as text: `2000`, or `1000 to 2000`."""
    return " to ".join(dict.fromkeys(f"{value:g}" for value in (found.rates.least, found.rates.most)))


def _counts(info: SetInfo, totals: Mapping[str, Statistics]) -> str:
    """Return the table of splits."""
    lines = ["| split | clips | frames | frames x rows x columns | shards | MB |", "|---|--:|--:|---|--:|--:|"]
    for split, shards in info.shards.items():
        found = totals[split]
        size = sum(shard.size for shard in shards) / 1e6
        sizes = ", ".join(found.sizes)
        lines.append(f"| {split} | {found.clips} | {found.frames} | {sizes} | {len(shards)} | {size:.1f} |")
    return "\n".join(lines)


def _loading(info: SetInfo) -> str:
    """Return a program that loads the set."""
    program = LOADING[info.to].format(split=next(iter(info.shards)), field=info.columns[0])
    return f"```python\n{program}\n```"


def _fields(info: SetInfo) -> str:
    """Return the list of fields."""
    lines = [f"A field is {NAMES_IN_FORMAT[info.to]}.", ""]
    for column in info.columns:
        kind = column.rpartition("_")[0] if column.partition("_")[0] in ("codes", "truth") and "_" in column else column
        stream = ""
        if kind in ("codes", "truth"):
            number = int(column.rpartition("_")[2]) if "_" in column else 0
            stream = f" (`{info.streams[number]}`)"
        lines.append(f"- `{column}`{stream}: {FIELDS[kind]}")
    lines += [
        "",
        "The description states the clip (`info`: camera, exposure, unit of radiance, scene), its split and, by name, "
        "its `streams` with their fields, sensor and light. `frames` lists the frames of fields that lack some. A code "
        "of several frames is stated by `planes_per_code`. "
        + ("Packed rows hold codes of `bits` bits each, most significant bit first." if info.packed else ""),
    ]
    return "\n".join(lines).rstrip()


def _light(totals: Mapping[str, Statistics]) -> str:
    """Return the table of light and motion: mean, least and most over the clips."""
    names = tuple(totals)
    lines = [f"| mean (least to most) of the clips | {' | '.join(names)} |", f"|---{'|---' * len(names)}|"]
    rows = {
        "expected photons per pixel and exposure": "photons",
        "motion of what moves [px/frame]": "motion",
        "share of pixels that move": "moving",
        "PSNR of the radiance [dB]": "error",
    }
    for label, field in rows.items():
        values = [getattr(found, field).words() for found in totals.values()]
        if any(value != "-" for value in values):
            lines.append(f"| {label} | {' | '.join(values)} |")
    streams = dict.fromkeys(name for found in totals.values() for name in found.ppp)
    for name in streams:
        values = [found.ppp[name].words() if name in found.ppp else "-" for found in totals.values()]
        lines.append(f"| photons per pixel and code, `{name}` | {' | '.join(values)} |")
    return "\n".join(lines)


def _sensors(whole: Statistics, info: SetInfo) -> str:
    """Return the list of sensors."""
    return "\n".join(f"- `{name}`: {whole.sensors[name]}" for name in info.streams if name in whole.sensors)


def _licences(info: SetInfo, whole: Statistics, files: Sequence[str]) -> str:
    """Return the licence of the set and of what went in."""
    lines = [f"The set: {info.licence}." if info.licence else "The set: its maker has stated no licence.", ""]
    lines += [f"- [{name}]({name}), as it lay in the data set" for name in files]
    lines += [f"- {asset}: {licence}" for asset, licence in whole.licences.items()]
    lines += [f"- file {name}, SHA-256 {digest}" for name, digest in whole.files.items()]
    if not (files or whole.licences or whole.files):
        lines.append("All scenes are computed: no picture, mesh or recording of others went in.")
    return "\n".join(lines)


# ---- Pictures


def picture(sample: Sample) -> bytes:
    """Return radiance, codes, flow and depth of the middle frame side by side, as far as there, as a PNG."""
    clip = sample.clip
    middle = len(clip) // 2
    radiance = clip.radiance(middle)
    shown = [colour.tone_picture(radiance, colour.peak(radiance), colours=clip.bands is not None)]
    described = next(iter(sample.description["streams"].values()), None)
    if described and "codes" in described:
        codes = sample.arrays[described["codes"]]()
        info = next(iter(sample.streams.values()))
        shown.append(_codes(codes, info, packed=described["packed"]))
    if clip.has_truth and clip.info.has("truth", middle):
        there = clip.channels_of_truth(middle)
        if {"u", "v"} <= there:
            flow = clip.flow(middle)
            largest = float(np.nanmax(np.hypot(*flow), initial=0.0))
            shown.append(colour.flow_colours(flow, max(largest, 1e-6)))
        if "Z" in there and np.isfinite(clip.depth(middle)).any():
            depth = clip.depth(middle)
            shown.append(colour.depth_colours(depth, *colour.depth_range(depth)))
    joined = np.concatenate([_as_rgb(one) for one in shown], axis=1)
    return png(np.kron(joined, np.ones((-(-HEIGHT // len(joined)),) * 2 + (1,), np.uint8)))


def _codes(codes: Array, info: StreamInfo, *, packed: bool) -> Array:
    """Return the codes of the middle one as grey levels."""
    middle = codes[len(codes) // 2]
    if packed:
        middle = packing.unpack(middle, info.bits, info.shape[2])
    return colour.code_levels(middle, 2**info.bits - 1)


def _as_rgb(image: Array) -> Array:
    """Return a picture as uint8 [H, W, 3]."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
