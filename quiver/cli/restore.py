"""The command `quiver restore`: its options and its action."""

from __future__ import annotations

import time
from pathlib import Path

from qsim import records
from qsim.cli.command import command
from qsim.cli.console import RESUMES, bar, note, output
from qsim.plane_sums import PlaneSums
from quiver.cli.options import ResumedThreads, check_domain, given, use_threads
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.settings import RestoreSettings


@command(
    "quiver restore out/starter/clips/fan_0003 -o out/fan.npy",
    "quiver restore out/fan/streams/quiver-physical_3bit_3.25ppp.npy -o out/fan.npy --method out/mine",
    "quiver restore out/fan --ppp 3.25 -o out/fan.npy --method moment",
    "quiver restore cube.npy --width 320 --planes 7 --sensor spad-320x240 --frame-rate 10000 -o out/cube.npy",
    "quiver restore out/cubes/test -o out/submission.zip --planes 7",
    after_interrupt=RESUMES,
)
def restore(asked: RestoreSettings, sums: PlaneSums, options: RestoreOptions, limit: ResumedThreads) -> int:
    """Restore the codes, and print the cost of a frame."""
    from quiver import threads
    from quiver.data.clips import check_outside
    from quiver.restoration.automatic import chosen
    from quiver.restoration.restored_file import restore_to_file, unnamed
    from quiver.restoration.sources import assumed, codes_to_restore, refuse_idle, told_of_faults

    target: Path = asked.output
    if target.suffix == ".zip":
        return _restore_cubes(asked, sums, options, limit)
    if target.suffix != ".npy":
        raise ValueError(f"{target}: restored video is written as .npy; name a .npy file")
    check_outside(target)
    codes = codes_to_restore(asked, sums)
    for path in (target, target.with_suffix(".json")):
        if path.exists() and not asked.force and not unnamed(target):  # restore_to_file finishes its naming
            raise FileExistsError(f"{path}: exists; name another, or replace it with --force")
    threads.check(limit.threads)
    method, why = chosen(asked.method, codes, options)
    refuse_idle(given(options) | {"method": asked.method}, [method])
    check_domain(asked, [method], [codes])
    used = use_threads(limit.threads, threads.recorded(target.with_name(f"{target.name}.part.json")))
    for text in (why, told_of_faults(codes)):
        if text is not None:
            note(text)
    target.parent.mkdir(parents=True, exist_ok=True)
    lines = [assumed(codes, method)]
    started = time.monotonic()
    with bar(method.name) as progress:

        def shown(done: int, total: int) -> None:
            while lines and time.monotonic() > started + 2:  # as the bar: an early error stays one line
                note(lines.pop())
            progress(done, total)

        info = restore_to_file(
            codes, method, target, shown, force=asked.force, note=note, threads=used, chosen=why or ""
        )
    for line in lines:
        note(line)
    length, height, width = codes.shape
    size = f"{height} x {width}" + ("" if codes.colour is None else " in R, G, B")
    found = f"; {codes.scan}" if codes.scan else ""
    output(
        {"restored": str(target)} | records.plain(info, complete=True),
        f"{target}: {length} frames of {size} by {method.name}, {codes.rates}, "
        f"{info.seconds_per_frame:.3g} s per frame; photons, white of the sensor = {codes.white:.4g}{found}",
    )
    return 0


def _restore_cubes(asked: RestoreSettings, sums: PlaneSums, options: RestoreOptions, limit: ResumedThreads) -> int:
    """Restore cubes of the Single Photon Challenge into the zip of a submission."""
    from quiver.data.challenge import COLOURS, band_codes, cubes
    from quiver.restoration.automatic import chosen_for_all
    from quiver.restoration.sources import assumed, refuse, refuse_idle
    from quiver.restoration.submission import check_target, restore_cubes

    target: Path = asked.output
    idle = ("stream", "sensor", "ppp", "bits", "seed", "width", "frame_rate", "defects", "scan")
    refuse(asked, idle, f"{target} is a submission, whose layout states it")
    refuse(sums, ("start", "stop", "every", "summed"), "the challenge scores the last plane of all that a cube has")
    check_target(target, asked.force)
    found = cubes(asked.source)
    planes = sums.planes or 1
    bands = [band_codes(cube, colour, planes) for cube in found for colour in range(len(COLOURS))]
    method, why = chosen_for_all(asked.method, bands, options)
    refuse_idle(given(options) | {"method": asked.method}, [method])
    check_domain(asked, [method], bands, shown=1)
    use_threads(limit.threads)
    for text in (why, assumed(bands[0], method)):
        if text is not None:
            note(text)
    target.parent.mkdir(parents=True, exist_ok=True)
    with bar(method.name) as progress:
        info = restore_cubes(found, method, planes, target, progress, force=asked.force)
    score = "no truth beside them" if info.psnr is None else f"PSNR {info.psnr:.2f} dB"
    output(
        {"submission": str(target)} | records.plain(info, complete=True),
        f"{target}: {len(found)} pictures by {method.name}, {planes} planes per code, {score}, "
        f"{info.seconds_per_picture:.3g} s per picture",
    )
    return 0
