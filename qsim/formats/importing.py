"""Foreign files in: which format is it, read it, write it as ours (export.py is the way out).

    photon cube .npy (.gz), codes and light .npy, mp4, PNG, TIFF, SwissSPAD2 and SPAD512S .bin, visionsim, zarr, .mat,
    spike .dat  ->  Footage  ->  a clip of relative radiance (light), or a stream NAME.npy + NAME.json (codes)

What a file does not say (size, rate, transfer curve, which of two layouts) is asked for, never guessed. Which bit of a
byte is the first pixel, and which way is up, follows from the layout: what is assumed goes into the `source` of what is
made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.clip.clip import RELATIVE, Clip, ClipWriter
from qsim.clip.stream import FORMAT_VERSION, Stream
from qsim.files import VERSION, Progress
from qsim.formats import array_files, raw_cameras, video
from qsim.formats.recording import Footage, Hints, Marked, stated, turned

Reader = Callable[[Path, Hints], Footage]
LAYOUTS: dict[str, Reader] = {  # the names of --layout
    "cube": array_files.read_cube,
    "codes": array_files.read_codes_npy,
    "light": video.read_light_npy,
    "video": video.read_video,
    "png": video.read_png,
    "tiff": video.read_tiff,
    "swissspad2-half": raw_cameras.read_swissspad2_half,
    "swissspad2-full": raw_cameras.read_swissspad2_full,
    "spad512s": raw_cameras.read_spad512s,
    "visionsim": array_files.read_visionsim,
    "zarr": array_files.read_zarr,
    "mat": array_files.read_mat,
    "spike": raw_cameras.read_spike,
}
_WHOLE = "none: whole bytes per pixel"
# (bit order, orientation) of the layouts whose readers in arrays.py and video.py leave it out, and why it is assumed.
ASSUMED: dict[str, tuple[str, str]] = {
    "cube": ("msb", "upright"),  # np.packbits along rows, row 0 on top: so photoncube shows it
    "codes": (_WHOLE, "upright"),  # row 0 on top, as whatever draws an array draws it
    "light": (_WHOLE, "upright"),  # the same
    "video": (_WHOLE, "upright"),  # decoders give the top row first; a telephone's rotation tag is not followed
    "png": ("msb if 1-bit", "upright"),  # by the standard: leftmost pixel in the high bit, top row first
    "tiff": ("msb if 1-bit", "upright"),  # tifffile undoes FillOrder; an Orientation tag is not followed
    "visionsim": ("msb", "upright"),  # np.packbits along rows of pictures as rendered
    "zarr": (_WHOLE, "upright"),  # quanta-spad-sim draws row 0 on top
    "mat": (_WHOLE, "as stored"),  # OUTPUT's rows are the array's; which way the camera hung is not in a file
}
VIDEOS = (".mp4", ".avi", ".mov", ".mkv")
PICTURES = {".png": "png", ".tif": "tiff", ".tiff": "tiff"}
_SMALL = 8_388_608  # bytes that three raw layouts share


def detect(path: Path) -> str:
    """The layout's name, from names, signatures, side files and sizes; `ValueError` that lists the candidates."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if path.is_dir():
        return _detect_folder(path)
    suffix = "".join(path.suffixes[-2:]) if path.suffix == ".gz" else path.suffix.lower()
    simple = {".png": "png", ".tif": "tiff", ".tiff": "tiff", ".mat": "mat", ".dat": "spike", ".npy.gz": "cube"}
    if suffix in simple:
        return simple[suffix]
    if suffix in VIDEOS:
        return "video"
    if suffix == ".npy":
        return _detect_npy(path)
    if suffix == ".bin":
        return _detect_raw(path)
    raise ValueError(f"{path}: unknown kind of file; say which with --layout: {', '.join(LAYOUTS)}")


def recordings(folder: Path, layout: str | None) -> list[Path]:
    """What a folder of many recordings holds: videos anywhere below it (I2-2000FPS), or folders of pictures (X4K).

    Empty if `folder` is a file, or one recording itself.
    """
    if not folder.is_dir() or layout not in (None, "video", "png", "tiff"):
        return []
    if layout in (None, "video"):
        videos = sorted(file for file in folder.rglob("*") if file.suffix.lower() in VIDEOS)
        if videos or layout == "video":
            return videos
    if any(item.is_file() for item in folder.iterdir()):
        return []
    kinds = (layout,) if layout else ("png", "tiff")
    places = {file.parent for file in folder.rglob("*") if PICTURES.get(file.suffix.lower()) in kinds}
    return sorted(place for place in places if not any(place.glob("*.npy")))


def read(path: Path, hints: Hints | None = None, *, compared: tuple[str, ...] = ()) -> Footage:
    """Open a foreign file or folder; frames are read when asked for.

    `ValueError` for a hint that the file has no use for, but for those that the caller has `compared` with it.
    """
    hints = hints or Hints()
    layout = hints.layout or detect(path)
    if layout not in LAYOUTS:
        raise ValueError(f"layout {layout!r}: known are {', '.join(LAYOUTS)}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    asked = {"layout", "flip", "columns", *compared}
    footage = LAYOUTS[layout](path, cast(Hints, _Watched(hints, asked)))
    for field in fields(Hints):
        given = getattr(hints, field.name) != field.default
        if given and field.name not in asked:
            raise ValueError(f"{path}: --{field.name} changes nothing for {footage.source}; leave it out")
    if layout in ASSUMED:
        footage = stated(footage, *ASSUMED[layout])
    return turned(footage, hints)


@dataclass(frozen=True)
class _Watched:
    """Hints that note which of them a reader asks for: one that no reader asks for cannot act."""

    hints: Hints
    asked: set[str]

    def __getattr__(self, name: str) -> Any:
        self.asked.add(name)
        return getattr(self.hints, name)


@dataclass(frozen=True)
class Capture:
    """How footage was taken, which files rarely say."""

    frame_rate: float  # Hz
    exposure: float | None = None  # s; None: the whole frame
    sensor: str | None = None  # of codes: a name of qsim.devices, or a .toml file
    ppp: float | None = None  # of codes: mean light level, where the sensor's gain follows it
    split: str | None = None  # of light: train, val or test

    def __post_init__(self) -> None:
        if not 0 < self.frame_rate < float("inf"):
            raise ValueError(f"frame rate: expected frames per second above 0, got {self.frame_rate!r}")
        if self.exposure is not None and not 0 < self.exposure <= 1 / self.frame_rate * (1 + 1e-9):
            raise ValueError(
                f"exposure {self.exposure!r} s: expected more than 0 and at most a frame's {1 / self.frame_rate:g} s"
            )

    @property
    def seconds(self) -> float:
        return self.exposure if self.exposure is not None else 1 / self.frame_rate


def to_clip(
    footage: Footage, path: Path, capture: Capture, *, force: bool = False, progress: Progress | None = None
) -> Clip:
    """Light as a clip of relative radiance. `ValueError` for codes: they are not light."""
    if not footage.is_light:
        raise ValueError(
            f"{path}: {footage.source} holds codes, not light; name a stream to make, as in out/capture.npy"
        )
    if capture.sensor is not None or capture.ppp is not None:
        name = "sensor" if capture.sensor is not None else "ppp"
        raise ValueError(f"{path}: {footage.source} holds light, which no sensor made; leave --{name} out")
    frames, height, width = footage.shape
    meta: dict[str, Any] = {
        "shape": [frames, height, width],
        "frame_rate": capture.frame_rate,
        "shutter": capture.seconds * capture.frame_rate,
        "exposure": capture.seconds,
        "radiance_unit": RELATIVE,
        "camera": None,
        "source": {"format": footage.source} | footage.meta,
        "split": capture.split,
        "saturation": {"white": footage.white, "assumed": footage.white_assumed},
    }
    marked = footage.marked or _unmarked(footage)
    with ClipWriter(path, meta, force=force) as writer:
        for start, stop in _ranges(footage):
            for t, image, mask in zip(range(start, stop), *marked(start, stop), strict=True):
                if not writer.has(t):
                    writer.add(t, image, saturated=mask)
            if progress is not None:
                progress(stop, frames)
    return Clip.open(path)


def _unmarked(footage: Footage) -> Marked:
    """Light of which no reader said where it saturates."""

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        light = footage.read(start, stop)
        return light, np.zeros(light.shape, bool)

    return marked


def saturation_line(clip: Clip) -> str:
    """What is known of the saturation of an imported clip, and the share of its pixels."""
    known = clip.meta.get("saturation") or {"white": None, "assumed": True}
    white, count = known["white"], int(clip.meta.get("saturated_pixels") or 0)
    if white is None:
        return "saturation not known: floats have no largest value; say with --white where the camera saturates"
    said = f"white {white:g}{' assumed' if known['assumed'] else ''}"
    if count:
        return f"{said}: {100 * count / math.prod(clip.shape):.3g} % of pixels saturated"
    return f"{said}: no pixel reaches it" + ("; if the camera saturates below, say --white" if known["assumed"] else "")


def to_stream(
    footage: Footage, path: Path, capture: Capture, *, force: bool = False, progress: Progress | None = None
) -> Stream:
    """Codes as a stream beside no clip: PATH.npy and PATH.json. The sensor is the given one, else an ideal counter."""
    if footage.bits is None:
        raise ValueError(f"{path}: {footage.source} holds light, not codes; name a clip folder to make, as in out/clip")
    if capture.split is not None:
        raise ValueError(f"{path}: --split is stored in clips, and {footage.source} becomes a stream; leave it out")
    if capture.ppp is not None and capture.sensor is None:
        raise ValueError(f"{path}: --ppp sets the gain of a named sensor; name it with --sensor, or leave --ppp out")
    from qsim.sensor import devices, packing

    stem = path.with_suffix("") if path.suffix in (".npy", ".json") else path
    npy, description = stem.with_suffix(".npy"), stem.with_suffix(".json")
    for file in (npy, description):
        if file.exists() and not force:
            raise FileExistsError(f"{file}: exists; name another, or use --force to replace it")
        if file.exists() and (not description.is_file() or "ppp_factor" not in files.read_json(description)):
            raise FileExistsError(
                f"{file}: is not a stream, which is all that --force replaces; move it away, or name another"
            )
    frames, height, width = footage.shape
    sensor = _sensor(footage, capture, devices)
    npy.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(npy) as target:
        packed = (frames, height, packing.packed_width(width, footage.bits))
        np.lib.format.write_array_header_1_0(target, {"descr": "|u1", "fortran_order": False, "shape": packed})
        for start, block in blocks(footage):
            target.write(packing.pack(block, footage.bits).tobytes())
            if progress is not None:
                progress(start + len(block), frames)
        description.unlink(missing_ok=True)  # the old stream is accepted until the new one is whole
    meta = {
        "format_version": FORMAT_VERSION,
        "shape": [frames, height, width],
        "width": width,
        "bits": footage.bits,
        "bit_order": "msb",
        "orientation": footage.meta.get("orientation", "unknown"),  # never upright unless a reader says so
        "code_model": footage.code_model,
        "planes_per_code": 2**footage.bits - 1 if footage.code_model == "binary_sum" else 1,
        "frame_rate": capture.frame_rate,
        "exposure": capture.seconds,
        "sensor": sensor.to_dict(),
        "sensor_name": capture.sensor,
        "ppp_target": None,
        "ppp_factor": None,
        "radiance_unit": RELATIVE,
        "transfer": "linear",
        "seed": None,
        "source": {"format": footage.source} | footage.meta,
        "sha256": files.sha256(npy),
        "software": {"qsim": VERSION},
    }
    files.write_description(description, meta)
    return Stream.open(description)


def blocks(footage: Footage) -> Iterator[tuple[int, Array]]:
    """The frames in order, some at a time: (number of the first, frames)."""
    for start, stop in _ranges(footage):
        yield start, footage.read(start, stop)


def _ranges(footage: Footage) -> Iterator[tuple[int, int]]:
    """Numbers of the frames that are read at a time: (first, last + 1)."""
    frames, height, width = footage.shape
    step = max(1, min(256, (1 << 25) // (height * width)))
    for start in range(0, frames, step):
        yield start, min(start + step, frames)


def _sensor(footage: Footage, capture: Capture, devices: Any) -> Any:
    if capture.sensor is not None:
        return devices.load(capture.sensor, ppp=capture.ppp, bits=footage.bits, exposure=capture.seconds)
    from qsim.sensor.spad import BinarySPAD

    return BinarySPAD(pde=1.0, dark_count_rate=0.0, bits=footage.bits or 1)


def _detect_folder(path: Path) -> str:
    if (path / "transforms.json").is_file():
        return "visionsim"
    if (path / "transforms.db").is_file():
        raise ValueError(f"{path}: describes its frames in transforms.db; let visionsim write a transforms.json")
    if any((path / name).is_file() for name in ("zarr.json", ".zgroup", ".zarray")):
        return "zarr"
    if (path / "info.json").is_file() or any(path.glob("part_*.mat")):
        return "mat"
    for pattern, layout in (("*.png", "png"), ("*.tif*", "tiff")):
        if any(path.glob(pattern)):
            return layout
    if any(path.rglob("*.bin")):
        return _detect_raw(raw_cameras.raw_files(path)[0], many=True)
    raise ValueError(f"{path}: a folder of no known kind; say which with --layout: {', '.join(LAYOUTS)}")


def _detect_npy(path: Path) -> str:
    array = array_files.load_array(path)
    if array.dtype == bool:
        return "codes"
    if array.dtype != np.uint8:
        return "light"
    if array.ndim == 4:
        return "cube"
    top = max((int(array[t].max()) for t in range(len(array)) if array[t].size), default=0)
    bits = (top + 1).bit_length() - 1
    if top + 1 == 1 << bits and bits < 8:
        raise ValueError(
            f"{path}: uint8 up to {top}: codes of {bits} bits, packed planes or dark pictures; choose with "
            f"--layout codes (and --bits {max(bits, 1)}), --layout cube or --layout light"
        )
    return "cube"


def _detect_raw(path: Path, many: bool = False) -> str:
    size = path.stat().st_size
    if size == _SMALL + 4 or path.name.startswith("acq_"):
        return "spad512s"
    candidates = ["swissspad2-half", "swissspad2-full", "spad512s"]
    if many and path.name.startswith("filename"):
        candidates.pop()
    fitting = [
        name for name in candidates if size % (raw_cameras.RAW_FRAME // (1 + (name == "swissspad2-half"))) == 0 < size
    ]
    if not fitting:
        raise ValueError(
            f"{path}: {size} bytes fit none of {', '.join(candidates)}; the file is truncated, or another kind"
        )
    evidence = []
    for name in fitting:
        sample = LAYOUTS[name](path, Hints()).read(0, min(64, size // raw_cameras.RAW_FRAME) or 1)
        evidence.append(f"{name} (roughness {raw_cameras.roughness(sample):.2f})")
    raise ValueError(
        f"{path}: {size} bytes fit {', '.join(evidence)}; choose one with --layout (the right one is usually near 1)"
    )
