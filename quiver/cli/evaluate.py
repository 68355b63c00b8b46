"""The commands `quiver evaluate` and `quiver bench`, scores and costs of methods: their options and actions."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from qsim.checks import ArgumentError
from qsim.cli.command import Idle, command
from qsim.cli.console import RESUMES, WITHOUT_FORCE, bar, note, output, refuse_existing, running
from qsim.cli.options import check_free
from qsim.files import write_bytes, write_json
from qsim.kinds import Light, Text
from qsim.locks import Lock
from qsim.plane_sums import PlaneSums
from qsim.settings import setting
from qsim.words import frame_size
from quiver.cli.options import Threads, check_domain, given, renew, use_threads
from quiver.device import DEVICES
from quiver.evaluation.settings import PROTOCOLS, EvaluateSettings
from quiver.restoration.interface import MODES, PRECISIONS, RestoreOptions
from quiver.restoration.settings import method_names

if TYPE_CHECKING:
    from quiver.evaluation.comparison import Comparison

# Files of an evaluation, beside its clips of a test set
OURS = r"plan\.json|rows\.jsonl|evaluation\.(json|md|png)|crops_[^/]*\.png|crops/[^/]*\.npy|lock"

# ---- evaluate

_COUNTS = "is for clips, and --static scores measured counts"


def _is_one_clip(asked: EvaluateSettings) -> bool:
    return asked.source is not None and (Path(asked.source) / "clip.json").exists()


IDLE = (
    Idle(
        lambda asked, *_: _COUNTS if asked.static else "",
        ("output", "split", "stream", "sensor", "ppp", "protocol", "published", "force"),
    ),
    Idle(
        lambda asked, *_: "" if asked.static else "belongs to --static COUNTS",
        ("frames", "splits", "width", "start", "stop", "every", "summed"),
    ),
    Idle(
        lambda asked, *_: f"--protocol {asked.protocol} decides it" if asked.protocol else "",
        tuple(next(iter(PROTOCOLS.values()))),
    ),
    Idle(
        lambda asked, *_: (
            f"chooses clips of a data set, and {asked.source} is one clip"
            if _is_one_clip(asked) and asked.split != "all"
            else ""
        ),
        ("split",),
    ),
    Idle(
        lambda asked, *_: f"stream {asked.stream} is stored and has its own" if asked.stream else "",
        ("sensor", "ppp", "bits", "seed"),
    ),
    Idle(
        lambda asked, *_: (
            f"is for windows that are exposed now, and stream {asked.stream} is stored" if asked.stream else ""
        ),
        ("published",),
    ),
)


@command(
    "quiver evaluate out/starter -o out/table --methods naive,moment,out/mine,out/unet --ppp 3.25,9.75,26",
    "quiver evaluate out/planes -o out/sums --sensor spad-320x240 --planes 7 --ppp 4.9",
    "quiver evaluate out/starter/clips/fan_0003 -o out/fan_table --methods moment,mergenet --split all",
    "quiver evaluate I2-2000FPS/test -o out/published --protocol quiver-published --methods moment,out/mine",
    "quiver evaluate --static hazelnut_gates6_TKYX_uint8.npy --methods moment,mergenet",
    "quiver evaluate --static still.npy --width 512 --planes 7 --methods moment,mergenet",
    after_interrupt=RESUMES,
    idle=IDLE,
)
def evaluate(asked: EvaluateSettings, sums: PlaneSums, options: RestoreOptions, limit: Threads) -> int:
    """Score the methods, and write tables and pictures; return 1 if a method failed."""
    from quiver import threads
    from quiver.restoration.restorers import restorers
    from quiver.restoration.sources import refuse_idle

    if asked.force:
        running().after_interrupt = WITHOUT_FORCE
    threads.check(limit.threads)
    methods = restorers(asked.methods, options)
    refuse_idle(given(options), methods)
    use_threads(limit.threads)
    if asked.static is not None:
        return _run_static(asked, sums, methods)
    if asked.source is None or asked.output is None:
        raise ValueError("give a data set or clip folder and -o, or --static COUNTS")
    from quiver.evaluation import comparison as scoring
    from quiver.evaluation import summary

    with _prepared(asked, sums.planes, methods) as (comparison, remarks):
        with bar("rows", "row") as progress:
            rows = scoring.evaluate(comparison, methods, asked.folder, lambda what, done, total: progress(done, total))
        summary.write(asked.folder, comparison, methods, rows, remarks)
    output(summary.as_dict(comparison, methods, rows, remarks), summary.markdown(comparison, methods, rows, remarks))
    return 1 if any(row.failure for row in rows) else 0


@contextlib.contextmanager
def _prepared(
    asked: EvaluateSettings, planes: int | None, methods: Sequence[Any]
) -> Iterator[tuple[Comparison, list[str]]]:
    """Check what `quiver evaluate` scores, then hold the folder of its results; yield the settings and remarks."""
    from quiver.evaluation.comparison import check, streams

    comparison = _comparison(asked, planes)
    if comparison.test_set is None:
        check(comparison)
        remarks = check_domain(asked, methods, streams(comparison))
        with _folder(asked, comparison):
            yield comparison, remarks
        return
    from quiver.data.test_sets import TEST_SETS, counted, describe, import_test_set

    assert asked.protocol is not None
    which = TEST_SETS[asked.protocol]
    source = Path(asked.named)
    described = describe(source, which)
    with _folder(asked, comparison):
        with bar("clips", "clip") as progress:
            clips = import_test_set(source, which, Path(comparison.source), progress, described)
        line = counted(clips, which)
        note(line)
        yield comparison, [f"{line}; read from {source}", *check_domain(asked, methods, streams(comparison))]


@contextlib.contextmanager
def _folder(asked: EvaluateSettings, comparison: Comparison) -> Iterator[None]:
    """Hold the folder of an evaluation, which is made or with --force emptied; `ValueError` if another process does."""
    from quiver.evaluation.comparison import CLIPS, LOCK, check_folder

    check_folder(asked.folder, comparison, force=asked.force)
    asked.folder.mkdir(parents=True, exist_ok=True)
    lock = Lock(asked.folder / LOCK)
    if not lock.acquire():
        raise ValueError(f"{asked.folder}: another process evaluates here; wait for it to end, or choose another -o")
    try:
        if asked.force:
            from quiver.data import test_sets

            renew(asked.folder, "plan.json", f"{OURS}|{CLIPS}/{test_sets.OURS}")
        yield
    finally:
        lock.delete()


def _comparison(asked: EvaluateSettings, planes: int | None) -> Comparison:
    """Return what `quiver evaluate` scores on the clips of a data set, or on one clip."""
    from quiver.data.illumination import Illumination
    from quiver.evaluation.comparison import Comparison

    _check_source(asked)
    check_free(asked.folder)
    if asked.protocol is not None:
        return _published_test(asked)
    sensor = asked.sensor or ("quiver-published" if asked.published else "quiver-physical")
    own = sensor.endswith(".toml")  # the file states the bits
    over = None if asked.stream else planes
    lights = tuple(
        Illumination.of(sensor, ppp, bits).over(over, bits if asked.bits else None)
        for bits in asked.bits or ((None,) if own else (3,))
        for ppp in asked.ppp or (3.25,)
    )
    split = None if asked.split == "all" else asked.split or "test"
    summed = planes if asked.stream else None
    return Comparison(
        asked.named, split, lights, asked.seed or 0, asked.published, asked.stream, asked.peak, planes=summed
    )


def _check_source(asked: EvaluateSettings) -> None:
    """Raise `ValueError` if --force would remove the source with the imported clips, or a test set would hold them."""
    from quiver.evaluation.comparison import CLIPS

    source = Path(asked.named).resolve()
    clips = (asked.folder / CLIPS).resolve()
    if clips in (source, *source.parents) or (asked.protocol is not None and source in clips.parents):
        raise ValueError(
            f"{asked.named}: overlaps with {asked.folder / CLIPS}, which is for imported clips; choose another -o"
        )


def _published_test(asked: EvaluateSettings) -> Comparison:
    """Return what is scored on a test set of the paper, whose clips are imported into OUT/clips."""
    from quiver.data.illumination import Illumination
    from quiver.evaluation.comparison import CLIPS, Comparison

    assert asked.protocol is not None
    decided = PROTOCOLS[asked.protocol]
    folder = str(asked.folder / CLIPS)
    lights = tuple(
        Illumination.of(decided["sensor"], ppp, bits) for bits in decided["bits"] for ppp in asked.ppp or (3.25,)
    )
    return Comparison(
        folder, decided["split"], lights, asked.seed or 0, published=decided["published"], test_set=asked.protocol
    )


def _run_static(asked: EvaluateSettings, sums: PlaneSums, methods: Sequence[Any]) -> int:
    from quiver.data.clips import peak_of
    from quiver.data.photon_counts import is_stored, read_counts, read_planes
    from quiver.evaluation.json_values import json_safe
    from quiver.evaluation.static_object import FORMAT, counted, evaluate_static, markdown

    assert asked.static is not None
    if asked.source is not None:
        raise ValueError(f"{asked.source}: {_COUNTS}; leave one of them out")
    if asked.bits is not None and len(asked.bits) > 1:
        raise ValueError("--bits: measured counts are clipped to one depth; give one number")
    if not asked.static.is_file():
        raise FileNotFoundError(f"{asked.static}: no such file")
    planes = sums.any or asked.width is not None or is_stored(asked.static)
    counts = read_planes(asked.static, sums, asked.width) if planes else read_counts(asked.static)
    if counts.sums is not None and asked.bits is not None:
        raise ArgumentError("bits", f"sums of {counts.sums.planes} planes are not clipped; leave it out")
    bits = (asked.bits or (3,))[0] if counts.sums is None else counts.sums.bits
    frames = asked.frames or 11
    check_domain(asked, methods, [counted(counts, bits)])
    scores = evaluate_static(
        counts, methods, frames=frames, bits=bits, splits=asked.splits or 3, seed=asked.seed or 0, peak=asked.peak
    )
    found = {"format": FORMAT, "counts": str(asked.static), "frames": frames, "bits": bits}
    if counts.sums is not None:
        found |= {"planes_per_code": counts.sums.planes, "plane_rate": counts.plane_rate}
    found["peak"] = peak_of(counts.light, asked.peak)
    found["scores"] = [asdict(score) for score in scores]
    output(json_safe(found), markdown(counts, scores, frames, bits, asked.peak))
    return 1 if any(score.failure for score in scores) else 0


# ---- bench


@dataclass(frozen=True)
class Bench:
    """The methods whose cost is measured, on one fixed clip."""

    methods: Annotated[
        tuple[Text, ...],
        setting(
            "methods, weights, folders of runs, and presets, with random weights unless some ship; comma-separated",
            unset="moment,unet,mergenet",
            known=method_names,
        ),
    ] = ("moment", "unet", "mergenet")
    modes: Annotated[
        tuple[Text, ...] | None,
        setting("modes of networks", unset="exact,streaming", shown="MODES", choices=MODES),
    ] = None
    precisions: Annotated[
        tuple[Text, ...] | None,
        setting("precisions of networks", unset="float32", shown="PRECISIONS", choices=PRECISIONS),
    ] = None
    size: Annotated[tuple[int, int], setting("ROWSxCOLUMNS in px", unset="64x64", read=frame_size)] = (64, 64)
    ppp: Annotated[Light, setting("light of the fixed clip")] = 3.25
    device: Annotated[str | None, setting("device", unset="auto", choices=DEVICES)] = None
    output: Annotated[Path | None, setting("folder for bench.md, bench.json, bench.png", short="o")] = None
    force: Annotated[bool, setting("replace an existing result")] = False


@command(
    "quiver bench",
    "quiver bench --methods moment,mergenet,quiver-s --modes exact,streaming,windows --size 128x128 -o out/bench",
    idle=[
        Idle(lambda asked, _: "" if asked.output else "replaces a result in -o FOLDER, which is not given", ("force",))
    ],
)
def bench(asked: Bench, limit: Threads) -> int:
    """Measure time and memory of a frame by each method; return 1 if a method failed."""
    from quiver import threads
    from quiver.evaluation import cost
    from quiver.evaluation.cost import CostSettings, checked_cases, device_of, figure, markdown
    from quiver.evaluation.json_values import json_safe
    from quiver.training.run_folder import alone_in

    if asked.output is not None:
        check_free(asked.output)
        for written in ("bench.json", "bench.md", "bench.png"):
            refuse_existing(asked.output / written, asked.force)
    threads.check(limit.threads)
    cases = checked_cases(asked.methods, asked.modes, asked.precisions, asked.device)
    height, width = asked.size
    with contextlib.ExitStack() as stack:
        if asked.output is not None:
            asked.output.mkdir(parents=True, exist_ok=True)
            stack.enter_context(alone_in(asked.output, "measures"))
        device = device_of(cases, asked.device)
        settings = CostSettings(height, width, ppp=asked.ppp, device=device, threads=use_threads(limit.threads))
        progress = stack.enter_context(bar("cases", "case"))
        costs = cost.bench(cases, settings, progress)
        text = markdown(costs, settings)
        found = json_safe({"setting": asdict(settings), "costs": [asdict(one) for one in costs]})
        if asked.output is not None:
            write_bytes(asked.output / "bench.md", text.encode())
            figure(costs, asked.output / "bench.png")
            write_json(asked.output / "bench.json", found)
    output(found, text)
    return 1 if any(one.failure for one in costs) else 0
