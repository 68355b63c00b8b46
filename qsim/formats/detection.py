"""Names the layout of a foreign file or folder from names, signatures, side files and sizes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qsim.files import load_array
from qsim.formats import array_files, hdf5, images, mat_files, photon_times, raw_cameras, raw_layout, tcspc, video
from qsim.formats.recording import Hints, Recording
from qsim.lazy_array import LazyArray

SMOOTH = 1.5  # roughness below which a layout may be right, and how much rougher the next one must then be


@dataclass(frozen=True)
class KnownLayout:
    """How a layout is read, and the hints that its codes and its light take; any other hint is refused."""

    read: Callable[[Path, Hints], Recording]
    codes: tuple[str, ...] = ()
    light: tuple[str, ...] = ()

    def takes(self, recording: Recording) -> tuple[str, ...]:
        return self.light if recording.is_light else self.codes


_AXES = ("axes", "channel", "slice")
_LIGHT = ("transfer", "white", "black")
_SIZE = ("height", "width")
_PACKED = (*_SIZE, "skip_bytes", "row_padding")
_RAW = (*_PACKED, "bits", "order", "endian")
LAYOUTS: dict[str, KnownLayout] = {  # by the names of layouts
    "cube": KnownLayout(array_files.read_cube, codes=("channel", "width")),
    "codes": KnownLayout(array_files.read_codes_npy, codes=(*_AXES, "bits")),
    "light": KnownLayout(array_files.read_light_npy, light=(*_AXES, *_LIGHT)),
    "video": KnownLayout(video.read_video, light=_LIGHT),
    "png": KnownLayout(images.read_png, codes=("bits", "stretched"), light=_LIGHT),
    "tiff": KnownLayout(images.read_tiff, codes=(*_AXES, "bits", "stretched"), light=(*_AXES, *_LIGHT)),
    "swissspad2-half": KnownLayout(raw_cameras.read_swissspad2_half),
    "swissspad2-full": KnownLayout(raw_cameras.read_swissspad2_full),
    "spad512s": KnownLayout(raw_cameras.read_spad512s),
    "visionsim": KnownLayout(array_files.read_visionsim, codes=("channel", "bits")),
    "zarr": KnownLayout(array_files.read_zarr, codes=("bits",)),
    "mat": KnownLayout(mat_files.read_mat, codes=("variable", "bits")),
    "hdf5": KnownLayout(hdf5.read_hdf5, codes=(*_AXES, "dataset", "bits"), light=(*_AXES, "dataset", *_LIGHT)),
    "spike": KnownLayout(raw_cameras.read_spike, codes=_SIZE),
    "photons": KnownLayout(photon_times.read_photons, codes=("bits",)),
    "raw": KnownLayout(raw_layout.read_raw, codes=_RAW, light=(*_RAW, *_LIGHT)),
    "mono10p": KnownLayout(raw_layout.read_mono10p, codes=_PACKED, light=(*_PACKED, *_LIGHT)),
    "mono12p": KnownLayout(raw_layout.read_mono12p, codes=_PACKED, light=(*_PACKED, *_LIGHT)),
    "mono10packed": KnownLayout(raw_layout.read_mono10packed, codes=_PACKED, light=(*_PACKED, *_LIGHT)),
    "mono12packed": KnownLayout(raw_layout.read_mono12packed, codes=_PACKED, light=(*_PACKED, *_LIGHT)),
    "mraw": KnownLayout(raw_layout.read_mraw, light=_LIGHT),
    "ptu": KnownLayout(tcspc.read_ptu, codes=(*_AXES, "bits")),
    "sdt": KnownLayout(tcspc.read_sdt, codes=(*_AXES, "bits")),
}
_WHOLE = "none: whole bytes per pixel"
# (bit order, orientation) of layouts whose readers do not state it, and the reason for it.
ASSUMED: dict[str, tuple[str, str]] = {
    "cube": ("msb", "upright"),  # np.packbits along rows, row 0 on top: so photoncube shows it
    "codes": (_WHOLE, "upright"),  # row 0 on top, as arrays are shown
    "light": (_WHOLE, "upright"),  # the same
    "video": (_WHOLE, "upright"),  # decoders give the top row first; video.py turns as the display matrix states
    "png": ("msb if 1-bit", "upright"),  # by the standard: leftmost pixel in the high bit, top row first
    "tiff": ("msb if 1-bit", "upright"),  # tifffile undoes FillOrder; an Orientation tag is not applied
    "visionsim": ("msb", "upright"),  # np.packbits along rows of pictures as rendered
    "zarr": (_WHOLE, "upright"),  # quanta-spad-sim draws row 0 on top
    "photons": (_WHOLE, "upright"),  # as the stream that it was made from
    "ptu": (_WHOLE, "as stored"),  # in the order of the scan
    "sdt": (_WHOLE, "as stored"),
    "hdf5": (_WHOLE, "upright"),  # as arrays are shown
    "mat": (_WHOLE, "as stored"),  # OUTPUT's rows are the array's; the camera's orientation is not in a file
}
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".ts", ".m4v", ".gif")
PICTURES = {".png": "png", ".tif": "tiff", ".tiff": "tiff"}
ZARR = ("zarr.json", ".zgroup", ".zarray")
PARTS = (*PICTURES, ".json", ".db", ".mat", ".bin", ".npy")  # kinds of files that make a folder a single recording
_SMALL = 8_388_608  # bytes that three raw layouts share


def detect(path: Path, hints: Hints | None = None) -> str:
    """Return the name of the layout; `ValueError` lists the candidates if there are several or none.

    Of an array, hints that only one layout has decide.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if path.is_dir():
        return _detect_folder(path)
    suffix = "".join(path.suffixes[-2:]) if path.suffix == ".gz" else path.suffix.lower()
    simple = {".png": "png", ".tif": "tiff", ".tiff": "tiff", ".mat": "mat", ".dat": "spike", ".npz": "photons"}
    simple |= {".mraw": "mraw", ".cihx": "mraw", ".cih": "mraw", ".ptu": "ptu", ".sdt": "sdt"}
    simple |= dict.fromkeys((".h5", ".hdf5", ".hdf", ".he5", ".nxs"), "hdf5")
    if suffix in simple:
        return simple[suffix]
    if suffix in VIDEOS:
        return "video"
    if suffix in (".npy", ".npy.gz"):
        return _detect_npy(path, hints or Hints())
    if suffix == ".bin":
        return _detect_raw(path)
    raise ValueError(f"{path}: unknown kind of file; name its layout=: {', '.join(LAYOUTS)}")


def recordings(folder: Path, layout: str | None) -> list[Path]:
    """Return the recordings below a folder: videos at any depth (I2-2000FPS), or folders of pictures (X4K).

    Empty if `folder` is a file or a single recording. Hidden files, and notes and archives beside the folders of
    pictures, are left out.
    """
    if not folder.is_dir() or layout not in (None, "video", "png", "tiff"):
        return []
    files = [file for file in folder.rglob("*") if not file.name.startswith(".")]
    if layout in (None, "video"):
        videos = sorted(file for file in files if file.suffix.lower() in VIDEOS)
        if videos or layout == "video":
            return videos
    kinds = (layout,) if layout else ("png", "tiff")
    places = {file.parent for file in files if PICTURES.get(file.suffix.lower()) in kinds}
    if any(item.is_file() and (item.suffix.lower() in PARTS or item.name in ZARR) for item in folder.iterdir()):
        if folder in places and len(places) > 1:
            inner = min(places - {folder})
            raise ValueError(f"{folder}: holds pictures and folders of pictures ({inner}); move one of them away")
        return []
    return sorted(place for place in places if not any(place.glob("*.npy")))


def check_one_kind(folder: Path, found: list[Path]) -> None:
    """Raise `ValueError` if a folder holds pictures or arrays beside the videos that were `found` in it."""
    if not found or found[0].is_dir():
        return
    kinds = {*PARTS, ".dat"} - {".json"}  # exports have a .json beside them
    files = [file for file in folder.rglob("*") if not file.name.startswith(".")]
    others = sorted(file for file in files if file.suffix.lower() in kinds or file.name in ZARR)
    if others:
        raise ValueError(
            f"{folder}: holds videos ({found[0]}) and other recordings ({others[0]}); choose with layout=, as in "
            "layout=video or layout=png"
        )


def _detect_folder(path: Path) -> str:
    if (path / "transforms.json").is_file() and not any(path.glob("*.png")):  # our pictures with poses have both
        return "visionsim"
    if (path / "transforms.db").is_file():
        raise ValueError(f"{path}: describes its frames in transforms.db; let visionsim write a transforms.json")
    if any((path / name).is_file() for name in ZARR):
        return "zarr"
    if (path / "info.json").is_file() or any(path.glob("part_*.mat")):
        return "mat"
    shown = sorted(file for file in path.iterdir() if file.suffix.lower() in PICTURES and file.name[0] != ".")
    raw = sorted(path.rglob("*.bin"))
    arrays = sorted(file for file in path.iterdir() if file.suffix.lower() in (".npy", ".npz", ".dat", ".mat"))
    kinds = {PICTURES[file.suffix.lower()]: file for file in shown}
    kinds |= {kind: found[0] for kind, found in (("raw", raw), ("array", arrays)) if found}
    if len(kinds) > 1:
        first, second, *_ = kinds.values()
        raise ValueError(f"{path}: holds recordings of two kinds ({first}, {second}); choose with layout=")
    if shown:
        return PICTURES[shown[0].suffix.lower()]
    if raw:
        return _detect_raw(raw_layout.raw_files(path)[0], many=True)
    raise ValueError(f"{path}: a folder of unknown kind; name its layout=: {', '.join(LAYOUTS)}")


def _detect_npy(path: Path, hints: Hints) -> str:
    array = load_array(path)
    if array.dtype == bool:
        return "codes"
    if hints.transfer is not None or hints.white is not None:
        return "light"
    if array.dtype != np.uint8:
        return "codes" if hints.bits is not None and array.dtype.kind in "ui" else "light"
    if (
        (array.ndim == 4 and hints.axes is None)
        or hints.width is not None
        or array_files.written_with(path, f"{path.name}.json") is not None
    ):
        return "cube"
    if hints.axes is not None:
        return "codes" if hints.bits is not None else "light"
    top = max((int(array[t].max()) for t in range(len(array)) if array[t].size), default=0)
    bits = max(top.bit_length(), 1)
    if hints.bits is not None and bits <= hints.bits:
        return "codes"
    if bits < 8:  # every eighth column of packed planes would be dark
        raise ValueError(
            f"{path}: uint8 up to {top}: codes of {bits} bits, packed planes or dark pictures; choose with "
            f"layout=codes (and bits={bits}), layout=cube or layout=light"
        )
    if _smooth(array):
        raise ValueError(
            f"{path}: uint8 up to {top}, much alike along rows: pictures or packed planes; choose with layout=light "
            "(and transfer=) or layout=cube"
        )
    return "cube"


def _smooth(array: LazyArray) -> bool:
    """Return whether neighbours along the rows of uint8 [T, H, W] agree, as pixels do and bytes of planes do not."""
    if array.ndim != 3 or array.shape[2] < 2 or array.size == 0:
        return False
    values = array[:8].astype(np.float64)
    return bool(np.mean(np.diff(values, axis=2) ** 2) < 0.2 * values.var())  # their correlation is above 0.9


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
    found = []
    for name in fitting:
        sample = LAYOUTS[name].read(path, Hints()).read(0, min(64, size // raw_cameras.RAW_FRAME) or 1)
        found.append(raw_cameras.roughness(sample))
        evidence.append(f"{name} (roughness {found[-1]:.2f})")
    least, second = sorted(found)[:2]
    clear = least < SMOOTH and second > SMOOTH * least
    tells = "the right one is usually near 1" if clear else "these frames are too noisy or too rough to tell"
    raise ValueError(f"{path}: {size} bytes fit {', '.join(evidence)}; choose one with layout= ({tells})")
