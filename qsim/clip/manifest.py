"""Defines clip.json: version, units, field names, and the checks of new and of stored clips."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

from qsim import files, structure
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.optics.zoom import Zoom

FORMAT_VERSION = 1
PHYSICAL = "W m^-2 sr^-1"
RELATIVE = "relative"
MEASURED = (  # fields of clip.json that the writer measures
    *("mean_radiance", "mean_photons", "clipped_pixels", "saturated_pixels", "checksums", "software", "checksum"),
    *("error_per_frame", "error_at_white_per_frame", "white", "psnr_of_truth", "psnr_unclamped", "fireflies_per_frame"),
)
OURS = r"clip\.json|(radiance|sharp|truth|saturated)/[0-9]{6,}\.exr|streams/lock|streams/[A-Za-z0-9._-]+\.(npy|json)"
TRUTH = {  # channel of the EXR file -> quantity
    "u": "flow",
    "v": "flow",
    "bu": "flow_back",
    "bv": "flow_back",
    "valid": "valid",
    "Z": "depth",
    "id": "body_id",
}
_DAMAGED = "the file is damaged; make the clip again, or take clip.json from a copy"


def read_manifest(path: Path) -> dict[str, Any]:
    """Return the contents of clip.json; `ValueError` names file and key if it is damaged or of another version."""
    meta = files.read_json(path)
    files.check_version(path, meta.get("format_version"), FORMAT_VERSION)
    structure.description(path, meta, structure.CLIP, _DAMAGED)
    if meta["radiance_unit"] not in (PHYSICAL, RELATIVE):
        raise ValueError(f"{path}: radiance_unit is {meta['radiance_unit']!r}; known are '{PHYSICAL}' and '{RELATIVE}'")
    if (meta.get("camera") is None) != (meta["radiance_unit"] == RELATIVE):
        raise ValueError(f"{path}: a clip in {PHYSICAL} needs a camera, and a relative one has none; {_DAMAGED}")
    for t in range(meta["shape"][0]):
        if f"radiance/{t:06d}.exr" not in meta["checksums"]:
            raise ValueError(f"{path}: checksums lack radiance/{t:06d}.exr of frame {t}; {_DAMAGED}")
    files.check_own(path, meta, _DAMAGED)
    return meta


def camera_of(meta: dict[str, Any], where: Path) -> Camera | None:
    """Return the camera that clip.json describes, without its motion; None for relative radiance."""
    described = meta.get("camera")
    if described is None:
        return None
    values = {key: value for key, value in described.items() if key not in ("kind", "motion")}
    for key in ("origin", "target", "up"):
        if values.get(key) is None:
            values.pop(key, None)
        else:
            values[key] = tuple(values[key])
    try:
        if values.get("lens") is not None:
            values["lens"] = _lens_of(values["lens"])
        if values.get("zoom") is not None:
            zoom = values["zoom"]
            lenses = tuple(_lens_of(lens) for lens in zoom["lenses"])
            values["zoom"] = Zoom(tuple(zoom["times"]), tuple(zoom["distances"]), lenses)
        return Camera(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: camera: {error}") from None


def _lens_of(described: dict[str, Any]) -> Lens:
    lens = {key: value for key, value in described.items() if key != "kind" and value is not None}
    return Lens(**lens | {key: tuple(lens[key]) for key in ("falloff", "shift")})


def check_new(path: Path, meta: dict[str, Any]) -> None:
    """Raise `ValueError` unless `meta` holds a valid shape, frame rate, exposure, unit and camera for a new clip."""
    shape = meta.get("shape")
    if not (isinstance(shape, list) and len(shape) == 3 and all(isinstance(n, int) for n in shape)):
        raise ValueError(f"{path}: shape must be [frames, height, width], got {shape!r}")
    if min(shape) < 1:
        raise ValueError(
            f"{path}: a clip needs at least one frame of one pixel, got {shape[0]} of {shape[1]} x {shape[2]}"
        )
    for key in ("frame_rate", "exposure"):
        value = meta.get(key)
        if not (isinstance(value, int | float) and value > 0):
            raise ValueError(f"{path}: {key} must be a number above 0, got {value!r}")
    if meta.get("radiance_unit") not in (PHYSICAL, RELATIVE):
        raise ValueError(
            f"{path}: radiance_unit must be '{PHYSICAL}' or '{RELATIVE}', got {meta.get('radiance_unit')!r}"
        )
    if (meta.get("camera") is None) != (meta["radiance_unit"] == RELATIVE):
        raise ValueError(f"{path}: a clip in {PHYSICAL} needs a camera, and a relative one has none")
    if not structure.is_bands(meta.get("bands", [1.0, 1.0, 1.0])):
        raise ValueError(f"{path}: bands must be three wavelengths in m, got {meta['bands']!r}; leave them out for one")


def target_of(path: str | os.PathLike[str], force: bool) -> Path:
    """Return the folder that a clip of this path is written to: a symbolic link stays, and its target is written.

    `FileExistsError` for a folder that may not be replaced, `NotADirectoryError` for a path below a file,
    `PermissionError` for one below a folder that cannot be written.
    """
    found = Path(path)
    files.check_name(found.name)
    if found.is_symlink():
        found = found.resolve()
    if found.exists() and not force:
        raise FileExistsError(f"{found}: exists; name another with -o, or use --force to replace it")
    check_replaced(found)
    above = next(parent for parent in found.absolute().parents if parent.exists())
    if not above.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(found))
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(f"{found}: no permission to write into {above}; name another with -o")
    return found


def check_replaced(path: Path) -> None:
    """Raise `FileExistsError` if something else than a clip, or a clip with other files in it, would be replaced."""
    if path.exists() and not (path / "clip.json").is_file():
        raise FileExistsError(
            f"{path}: exists and is not a clip, which is all that --force replaces; name another with -o"
        )
    if path.exists():
        files.check_ours(path, OURS)


def check_outside(path: Path) -> None:
    """Raise `FileExistsError` for an output in a clip or in its streams, where its .json would count as one."""
    for above in path.absolute().parents[:2]:
        if (above / "clip.json").is_file():
            raise FileExistsError(f"{path}: lies in the clip {above}, which holds nothing else; name another place")
