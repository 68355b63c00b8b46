"""Writes restored video to a file, block by block: resumable, complete or absent, by one writer at a time.

    PATH.npy.part, PATH.npy.part.json  ->  PATH.npy (float32 photons [T, H, W]; in colour [T, 3, H, W]) and PATH.json
    PATH.npy.lock                          held while a process writes

The disk space is reserved before the work begins. So a full disk is an error at the start, not a fault in the memory
map.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim import descriptions
from qsim.files import VERSION, Progress, read_json, sha256, sync_file, sync_folder
from qsim.kinds import Count, NotNegative
from qsim.locks import Lock
from qsim.restored_video import Restored, RestoredInfo, VideoInfo, describes_restored
from qsim.scratch import sweep
from quiver.data.codes import Codes
from quiver.device import out_of_memory
from quiver.restoration.interface import Restorer

BLOCK_FRAMES = 256  # restored between two entries of the journal
ZEROS = 1 << 24  # bytes written at a time where disk space is reserved by writing it
WHAT_CHANGED = {  # key of the description -> its name in the message that a restoration starts again
    "codes_sha256": "the codes",
    "colour": "the colour filters",
    "method": "the method",
    "description": "the method",
    "identity": "the method's settings or weights",
    "sensor": "the sensor",
    "shape": "the shape",
    "times": "the planes",
    "planes": "the planes",
    "source": "the source",
    "cuts": "the cuts between scenes",
    "quiver": "the program's version",
}


@dataclass(frozen=True, kw_only=True)
class Unfinished(VideoInfo):
    """The journal of a restoration: PATH.npy.part.json until the video is complete."""

    FORMAT: ClassVar[str] = "quiver-unfinished"

    done: Count = 0  # frames
    seconds: NotNegative = 0.0
    threads: Count | None = None
    device: str = ""


def restore_to_file(
    codes: Codes,
    method: Restorer,
    path: Path,
    progress: Progress | None = None,
    *,
    force: bool = True,
    note: Callable[[str], None] | None = None,
    threads: int | None = None,
    chosen: str = "",
) -> RestoredInfo:
    """Restore a stream into PATH.npy (float32 photons [T, H, W]) and PATH.json; return the description.

    Both appear when complete, the json last. Until then the video is PATH.npy.part, written in blocks of BLOCK_FRAMES.
    An interrupted restoration of the same codes by the same method resumes after its last block. If codes or method
    differ, it starts again and `note` receives the reason. `threads`, the device, and why the method was `chosen` are
    recorded in the description. A failure leaves nothing behind, unless memory was exhausted: finished blocks are kept.
    A link is followed.

    `ValueError` while another process writes PATH. `FileExistsError` if there is a result and `force` is not set, or a
    file that is not restored video.
    """
    path = path.resolve()
    part, journal = _parts(path)
    with _only_writer(path):
        sweep(path.parent)
        wanted = _described(codes, method)
        if unnamed(path):
            os.replace(journal, path.with_suffix(".json"))
            sync_folder(path.parent)
            if not _done(path, path.with_suffix(".json"), wanted)[2]:
                return Restored.open(path.with_suffix(".json")).info
        _check_target(path, journal, force)
        _check_unfinished(part, journal)
        try:
            seconds = _fill_file(codes, method, part, journal, wanted, progress, note, threads)
            info = RestoredInfo(
                **vars(wanted),
                seconds_per_frame=seconds / codes.shape[0],
                threads=threads,
                device=method.device,
                look_ahead=method.look_ahead,
                chosen=chosen,
                source_sha256=codes.source_sha256,
                sha256=sha256(part),
            )
            descriptions.write(journal, info)  # takes its disk space before anything is replaced
        except BaseException as error:
            resumable = not isinstance(error, Exception) or out_of_memory(error)
            if not (resumable and _has_frames(journal)):
                part.unlink(missing_ok=True)
                journal.unlink(missing_ok=True)
            if isinstance(error, OSError) and error.errno is not None and error.filename in (None, str(part)):
                error.filename = str(path)
            raise
        path.with_suffix(".json").unlink(missing_ok=True)
        os.replace(part, path)
        os.replace(journal, path.with_suffix(".json"))
        sync_folder(path.parent)
    return info


def _described(codes: Codes, method: Restorer) -> VideoInfo:
    """Return what is known of a video before it is restored, and what must agree to resume it."""
    by_places = {"bands": "R, G, B", "by": "places of the mask, then demosaicing"}
    plane_rate = None
    times = codes.times
    if codes.sums is not None:
        plane_rate = codes.frame_rate * codes.sums.step
        times = times or codes.sums.times(plane_rate)
    return VideoInfo(
        quiver=VERSION,
        method=method.name,
        description=method.description,
        identity=dict(method.identity) | {"cut": method.cut(*_at_a_time(codes))},
        white=codes.white,
        shape=codes.video_shape,
        frame_rate=codes.frame_rate,
        plane_rate=plane_rate,
        planes_per_code=1 if codes.sums is None else codes.sums.planes,
        planes=None if codes.sums is None else codes.sums.range,
        times=times,
        exposure=codes.exposure,
        sensor=codes.sensor.to_dict(),
        source=codes.source,
        codes_sha256=codes.digest(),
        colour={} if codes.colour is None else codes.colour.to_dict() | by_places,
        not_inverted=codes.not_inverted,
        scan=codes.scan,
        cuts=codes.cuts,
    )


@contextlib.contextmanager
def _only_writer(path: Path) -> Iterator[None]:
    """Hold PATH.npy.lock and delete it at the end. `ValueError` if another process holds it."""
    lock = Lock(path.with_name(path.name + ".lock"))
    if not lock.acquire():
        raise ValueError(f"{path}: another process is writing this video; wait for it, or name another")
    try:
        yield
    finally:
        lock.delete()


def unnamed(path: Path) -> bool:
    """Return whether a video lacks only the name of its description: its writer was killed between the two renames."""
    path = path.resolve()
    part, journal = _parts(path)
    return path.exists() and not (part.exists() or path.with_suffix(".json").exists()) and _complete(journal)


def _parts(path: Path) -> tuple[Path, Path]:
    """Return the names of an unfinished video and of its journal."""
    return path.with_name(path.name + ".part"), path.with_name(path.name + ".part.json")


def _has_frames(journal: Path) -> bool:
    """Return whether a journal records finished frames."""
    with contextlib.suppress(OSError, ValueError):
        found = read_json(journal)
        return bool(found.get("done")) or describes_restored(found)
    return False


def _complete(journal: Path) -> bool:
    """Return whether a journal describes a complete video: its writer was killed during the renames."""
    with contextlib.suppress(FileNotFoundError, ValueError):
        return describes_restored(read_json(journal))
    return False


def _check_target(path: Path, journal: Path, force: bool) -> None:
    """Raise `FileExistsError` if there is a file that may not be replaced."""
    if path.is_dir():
        raise FileExistsError(f"{path}: is a folder; name a file")
    for file in (path, path.with_suffix(".json")):
        if file.exists() and not force:
            raise FileExistsError(f"{file}: exists; name another, or replace it with force=True")
    description = path.with_suffix(".json")
    if description.exists() and not describes_restored(read_json(description)):
        raise FileExistsError(
            f"{description}: does not describe restored video, and nothing else is replaced; name another"
        )
    if path.exists() and not description.exists() and not _complete(journal):  # complete: killed while it replaced
        raise FileExistsError(
            f"{path}: has no .json that describes restored video, and nothing else is replaced; name another"
        )


def _check_unfinished(part: Path, journal: Path) -> None:
    """Raise `FileExistsError` if the names of unfinished work hold anything but that: a journal, and its video."""
    ours = not os.path.lexists(journal)
    if not ours and journal.is_file() and not journal.is_symlink():
        with contextlib.suppress(ValueError):
            found = read_json(journal)
            ours = found.get("format") in (RestoredInfo.FORMAT, Unfinished.FORMAT)
    foreign = [] if ours else [journal]
    if os.path.lexists(part) and (part.is_symlink() or not (part.is_file() and journal.exists())):
        foreign.append(part)
    if foreign:
        raise FileExistsError(
            f"{foreign[0]}: exists and is not an unfinished restoration of this program; move it away, or name another"
        )


def _fill_file(
    codes: Codes,
    method: Restorer,
    part: Path,
    journal: Path,
    wanted: VideoInfo,
    progress: Progress | None,
    note: Callable[[str], None] | None,
    threads: int | None,
) -> float:
    """Restore the missing frames of PART, record each block in JOURNAL, and return the seconds of all blocks."""
    length = codes.shape[0]
    done, seconds, why = _done(part, journal, wanted)
    if why and note is not None:
        note(f"{part}: holds an interrupted restoration, but {why}; starting again")
    if not done:  # the journal first: it proves that the video is ours
        descriptions.write(journal, Unfinished(**vars(wanted)))
        part.unlink(missing_ok=True)
        _reserve(part, codes.video_shape)
    out: Any = np.lib.format.open_memmap(part, mode="r+")
    block: Any = None
    try:
        for first in range(done, length, BLOCK_FRAMES if method.seamless else length):
            block = out[first : first + BLOCK_FRAMES if method.seamless else length]
            block[:] = 0  # an interrupted block may be partly written
            started = time.perf_counter()
            method.into(codes, block, first, _shifted(progress, first, length, len(block)))
            check_finite(block, method.name, first)
            out.flush()
            sync_file(part)  # the journal records frames that are on the disk
            seconds += time.perf_counter() - started
            reached = Unfinished(
                **vars(wanted), done=first + len(block), seconds=seconds, threads=threads, device=method.device
            )
            descriptions.write(journal, reached)
    finally:  # the traceback of an error keeps this frame, and a map the disk space of a deleted file
        out = None
        block = None
    return seconds


def _at_a_time(codes: Codes) -> tuple[int, int]:
    """Return height and width of what a method restores at a time: the frame, or one place of a mask."""
    rows, columns = codes.tile
    return -(-codes.shape[1] // rows), -(-codes.shape[2] // columns)


def _reserve(part: Path, shape: tuple[int, ...]) -> None:
    """Create a .npy of float32 of this shape and reserve its disk space. `OSError` if there is not enough."""
    with open(part, "xb") as file:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype(np.float32)), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        file.flush()
        start = file.tell()
        stop = start + 4 * int(np.prod(shape, dtype=np.int64))
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, stop)
        else:  # macOS
            for written in range(start, stop, ZEROS):
                file.write(bytes(min(ZEROS, stop - written)))


def _done(part: Path, journal: Path, wanted: VideoInfo) -> tuple[int, float, str]:
    """Return the finished frames and seconds of an interrupted restoration, and why it cannot be resumed, if so."""
    if not (part.exists() and journal.exists()):
        return 0, 0.0, ""
    try:
        found: Unfinished | RestoredInfo
        if _complete(journal):  # killed before the rename
            found = descriptions.read(journal, RestoredInfo, "restore the video again")
            done = found.shape[0] if found.shape is not None else 0
            seconds = done * found.seconds_per_frame
        else:
            found = descriptions.read(journal, Unfinished, "restore the video again")
            done = found.done
            seconds = found.seconds
    except ValueError as error:
        return 0, 0.0, f"its journal is damaged ({error})"
    # Threads and device may differ: on any device numbers agree to rounding.
    changed = [field.name for field in fields(VideoInfo) if getattr(found, field.name) != getattr(wanted, field.name)]
    if not changed:
        return done, seconds, ""
    told = dict.fromkeys(WHAT_CHANGED[key] for key in WHAT_CHANGED if key in changed)
    before = found.identity
    now = wanted.identity
    if changed == ["identity"] and before | {"cut": now["cut"]} == now:
        cuts = [tiles or "none" for tiles in (before.get("cut"), now["cut"])]
        return 0, 0.0, f"the tiles of a frame, by memory= and the device, were {cuts[0]} and are {cuts[1]} now"
    return 0, 0.0, f"{' and '.join(told) or 'its description'} changed since"


def _shifted(progress: Progress | None, first: int, length: int, block: int) -> Progress | None:
    """Return the progress of a block as progress of the complete stream, in frames."""
    if progress is None:
        return None
    return lambda done, total: progress(first + done * block // total, length)


def check_finite(restored: Array, name: str, first: int = 0) -> None:
    """Raise `ValueError` with the first frame that holds a NaN or Inf; frames are numbered from `first`."""
    for t, frame in enumerate(restored, start=first):
        if not np.isfinite(frame).all():
            raise ValueError(f"{name}: restored frame {t} holds NaN or Inf; are the weights damaged?")
