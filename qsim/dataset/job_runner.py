"""Runs one job of a data set: renders a clip, senses its streams, writes its record.

    work/KEY[.part]   the clip while it is rendered          (resumable, never read)
    clips/KEY         the finished clip with its streams
    jobs/KEY.json     the record (job_record.py); written last
    failed/KEY.json   the reason of a failure; removed when the job succeeds
    logs/KEY.log      date, machine, duration and memory; the only files that differ between two runs

KEY is the clip's name, with the folder of its block in data sets of more than a thousand clips (series.py).

A job is done when its record exists. A job killed before that is repeated from its last complete frame.
"""

from __future__ import annotations

import datetime
import os
import platform
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from qsim import descriptions, files, locks, scratch
from qsim.dataset.job import Job
from qsim.dataset.job_record import Failure, JobRecord, failure_path, record_path
from qsim.dataset.provenance import assets, origin, photographs
from qsim.process import peak_memory
from qsim.streams.clip import Clip
from qsim.streams.sensing import sensor_of
from qsim.streams.storing import sense

if TYPE_CHECKING:
    from qsim.rendering.budget import Budget
    from qsim.scene import Scene
    from qsim.streams.sensing import Sensing

RenderJob = Callable[[Job, Path], object]  # renders a job's clip to a path; tests use a quick one

FOLDERS = ("clips", "jobs", "failed", "logs", "locks", "work")  # inside a data set
LOCKS = "locks/clips"  # of jobs; those of generators are in locks
BLOCK_FOLDERS = ("clips", "jobs", "logs", LOCKS, "work")  # those in which every block has a folder


@dataclass(frozen=True)
class Result:
    """Result of one job."""

    name: str
    # "done", "failed", "full" (no space left), "gone" (the data set's folder) or "crashed" (the worker process)
    state: str
    message: str = ""


def render_job(job: Job, path: Path) -> object:
    """Render a job's clip with the budget that its wanted error and its brightest stream need."""
    from qsim.rendering.clip_rendering import render_clip

    settings = job.settings
    scene, read = load_traced(job)
    return render_clip(
        scene,
        path,
        frames=settings.frames,
        frame_rate=settings.frame_rate,
        shutter=settings.shutter,
        seed=render_seed(job),
        budget=choose_budget(job, scene),
        made_of=replace(origin(job, read), assets=tuple(sorted(assets(scene.to_dict()) + photographs(scene)))),
        force=True,  # replaces an unfinished clip of other settings
    )


def load_scene(job: Job) -> Scene:
    """Return the job's scene at its size."""
    return load_traced(job)[0]


def load_traced(job: Job) -> tuple[Scene, dict[str, str]]:
    """Return the job's scene at its size, and the SHA-256 of each file of the user that it read."""
    from qsim.dataset import scene_files
    from qsim.dataset.scene_rendering import along_path, in_bands, in_colour

    settings = job.settings
    moved = settings.camera_path is not None
    size = settings.size
    scene, read = scene_files.load(
        job.family,
        job.scene_seed,
        job.speed,
        along_path=moved,
        bands=settings.bands,
        camera=settings.camera,
        start=settings.start,
    )
    coloured = in_colour(scene, job.family)
    scene = along_path(scene, settings.camera_path, settings.frame_rate, size, job.speed)
    sized = scene.resized(*size)
    return sized if coloured else in_bands(sized, settings.bands), read


def render_seed(job: Job) -> int:
    """Return the seed of the job's samples, which differs from clip to clip."""
    from qsim import keys

    # The renderer takes seeds of 31 bits.
    return (keys.hash_name(job.name) ^ job.seed) & 0x7FFFFFFF


def choose_budget(job: Job, scene: Scene) -> Budget:
    """Choose the budget for the wanted error and for the noise of the stream that collects most electrons per frame.

    The noise of frames averages in a code that sums several. What repeats in all of them does not: its limit follows
    from the stream that collects most electrons per code. Where all streams sum frames, these share the noise of a
    code. Streams in lux or with absolute light set no limit: their photons are known only after rendering.
    """
    from qsim.rendering import fidelity
    from qsim.sensor.file_laws import Conditions

    settings = job.settings
    electrons = 0.0
    of_code = 0.0
    ppp = None
    for sensing in job.streams:
        if sensing.ppp is not None:
            conditions = Conditions(sensing.temperature, scene.camera.wavelength)
            sensor = sensor_of(sensing, ppp=sensing.ppp, exposure=1 / settings.frame_rate, conditions=conditions)
            share = sensor.efficiency
            of_frame = sensing.ppp / sensing.frames
            of_code = max(of_code, of_frame * share * sensing.frames)
            if of_frame * share > electrons:
                electrons = of_frame * share
                ppp = of_frame
    return fidelity.choose_budget(
        scene,
        frame_rate=settings.frame_rate,
        shutter=settings.shutter,
        frames=settings.frames,
        psnr=settings.psnr,
        ppp=ppp,
        quantum_efficiency=1.0 if ppp is None else electrons / ppp,
        planes=1.0 if ppp is None else of_code / electrons,
        codes=[frames_together(sensing) for sensing in job.streams],
        reuse=settings.reuse,
        seed=render_seed(job),
    )


def frames_together(sensing: Sensing) -> int:
    """Return the clip frames whose noise averages in each pixel of each code of a stream, counted from frame 0 on.

    Rows with their own time begin elsewhere, and short exposures see a part of the frames: 1.
    """
    if sensing.rows is not None or any(share != 1 for share in sensing.exposures or ()):
        return 1
    return sensing.frames


def removed(folder: Path) -> str:
    """Return which part of a data set's folder was removed, and what to do; empty if none was."""
    gone = [place for place in (folder, *(folder / name for name in FOLDERS)) if not place.is_dir()]
    return f"{gone[0]}: was removed while the data set was being made; run the same command again" if gone else ""


def run_job(job: Job, folder: Path, make: RenderJob = render_job) -> Result:
    """Run the missing steps of a job. Failures are written to failed/ and returned, not raised."""
    lock = locks.Lock(lock_path(folder, job))
    try:
        make_block(folder, job)
        try:
            lock.acquire(wait=True)  # another process may still be ending with this job
            if record_path(folder, job.key).is_file():
                return Result(job.name, "done")
            return _do(job, folder, make)
        except Exception as error:
            # These are no fault of the job: the whole run has to stop.
            if isinstance(error, OSError) and (error.errno in files.FULL or removed(folder)):
                raise
            _log(folder, job.key, traceback.format_exc())
            message = files.wording(error)
            if not isinstance(error, ValueError | OSError):
                message = f"{type(error).__name__}: {message}"
            mark_failed(folder, job, message)
            return Result(job.name, "failed", message)
    except OSError as error:
        if error.errno in files.FULL:
            return Result(job.name, "full", f"{error.strerror} while making {job.name}")
        if lost := removed(folder):
            return Result(job.name, "gone", lost)
        raise
    finally:
        lock.release()


def lock_path(folder: Path, job: Job) -> Path:
    """Return the lock of a job."""
    return folder / LOCKS / job.key


def _do(job: Job, folder: Path, make: RenderJob) -> Result:
    """Make clip, streams and record; each is complete before the next begins."""
    started = time.monotonic()
    worked = time.process_time()
    for path in (record_path(folder, job.key), failure_path(folder, job.key), folder / "clips" / job.key):
        scratch.sweep(path.parent)
    clip = _clip(job, folder, make)
    rendered = time.monotonic()
    for sensing in job.streams:
        _, line = sense(clip, sensing)
        _log(folder, job.key, line)
    # The record comes last, because its presence means that the job is done.
    descriptions.write(record_path(folder, job.key), JobRecord.of(job))
    failure_path(folder, job.key).unlink(missing_ok=True)
    seconds = (rendered - started, time.monotonic() - rendered)
    spent = f"clip {seconds[0]:.2f} s, streams {seconds[1]:.2f} s, "
    spent += f"processor {time.process_time() - worked:.2f} s, peak {peak_memory() >> 20} MiB"
    _log(folder, job.key, f"done on {platform.node()}, process {os.getpid()}: {spent}")
    return Result(job.name, "done")


def make_block(folder: Path, job: Job) -> None:
    """Make the folders of a job's block, or of all where there are no blocks; not in a data set that was removed."""
    if removed(folder):
        return
    for name in BLOCK_FOLDERS if job.block else (LOCKS,):
        (folder / name / job.block).mkdir(parents=True, exist_ok=True)
    for name in (LOCKS, "work") if job.block else (LOCKS,):
        scratch.sweep(folder / name / job.block)


def mark_failed(folder: Path, job: Job, message: str) -> None:
    """Write the reason of a failure; `generate` lists it until the job is retried."""
    note = Failure(name=job.name, digest=job.digest, error=message or "it does not say why")
    if job.block:
        failure_path(folder, job.key).parent.mkdir(parents=True, exist_ok=True)
    descriptions.write(failure_path(folder, job.key), note)


def _clip(job: Job, folder: Path, make: RenderJob) -> Clip:
    """Return the job's finished clip, rendered if it does not exist."""
    path = folder / "clips" / job.key
    work = folder / "work" / job.key
    if path.is_symlink() and not path.is_dir():
        raise ValueError(
            f"{path}: is a symbolic link to {os.readlink(path)}, which is not there; mount or move it back, or delete "
            "the link"
        )
    if not path.is_dir():
        if not work.is_dir():
            _log(folder, job.key, f"rendering on {platform.node()}, process {os.getpid()}")
            make(job, work)
        os.replace(work, path)
        files.sync_folder(path.parent)
    clip = Clip.open(path)
    if clip.info.job != job.digest:
        raise ValueError(f"{path}: was made by another recipe; use another folder")
    return clip


def _log(folder: Path, key: str, text: str) -> None:
    """Append a line with the time to the job's log."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    files.append_line(folder / "logs" / f"{key}.log", f"{now} {text}".encode())
