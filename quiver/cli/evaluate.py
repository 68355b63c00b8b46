"""The commands `quiver evaluate` and `quiver bench`, scores and costs of methods: their options and actions."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qsim import checks
from qsim.cli.console import WITHOUT_FORCE, bar, note, output, refuse_existing
from qsim.cli.options import check_free, checked, count, frame_size, positive, words
from qsim.files import write_bytes, write_json
from qsim.locks import Lock
from quiver.cli.options import (
    add_light,
    add_running,
    add_strict,
    add_threads,
    check_domain,
    command,
    renew,
    running_options,
    use_threads,
)
from quiver.device import DEVICES

if TYPE_CHECKING:
    from quiver.evaluation.comparison import Comparison

# Files of an evaluation, beside its clips of a test set
OURS = r"plan\.json|rows\.jsonl|evaluation\.(json|md|png)|crops_[^/]*\.png|crops/[^/]*\.npy|lock"

# evaluate


def add_evaluate(sub: Any) -> None:
    parser = command(
        sub,
        "evaluate",
        _run_evaluate,
        "Compare methods on held-out clips, or on real photons of a static object.",
        "quiver evaluate out/starter -o out/table --methods naive,moment,out/mine,out/unet --ppp 3.25,9.75,26\n"
        "quiver evaluate out/starter/clips/fan_0003 -o out/fan_table --methods moment,mergenet --split all\n"
        "quiver evaluate I2-2000FPS/test -o out/published --protocol quiver-published --methods moment,out/mine\n"
        "quiver evaluate --static hazelnut_gates6_TKYX_uint8.npy --methods moment,mergenet",
        resumes=True,
    )
    parser.add_argument("source", nargs="?", help="data set or clip folder; with --protocol the folder of a test set")
    parser.add_argument("-o", "--output", type=Path, help="folder for evaluation.md, .json, .png (needed for clips)")
    parser.add_argument(
        "--methods",
        type=words,
        default="naive,moment",
        help="comma-separated; `moment:3` uses a 3-frame window; `all` runs every method (default naive,moment)",
    )
    parser.add_argument("--split", choices=("train", "val", "test", "all"), help="split of a data set (default test)")
    parser.add_argument("--stream", help="score this stored stream of every clip, instead of sensing the clip now")
    add_light(parser, several=True)
    parser.add_argument(
        "--seed", type=checked(checks.seed), help="seed of the test noise or of the random splits (default 0)"
    )
    parser.add_argument("--published", action="store_true", help="expose, scale and score every window separately")
    parser.add_argument(
        "--protocol",
        choices=("quiver-published", "x4k1000fps"),
        help="the paper's test on I2-2000FPS or X4K1000FPS, read from the folders as they are published",
    )
    parser.add_argument(
        "--peak", type=positive, help="photons per pixel that the scores refer to (default 2.5 x the mean light)"
    )
    parser.add_argument(
        "--static", type=Path, metavar="COUNTS", help="photon counts [N,H,W] or [T,K,H,W], .npy or .npz"
    )
    parser.add_argument("--frames", type=count, help="static: frames to restore from (default 11)")
    parser.add_argument("--splits", type=count, help="static: random splits (default 3)")
    add_running(parser, resumed=False)
    add_strict(parser)
    parser.add_argument("--force", action="store_true", help="replace an existing evaluation")


def _run_evaluate(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.restoration.restorers import restorers
    from quiver.restoration.sources import refuse_idle

    if args.force:
        args.after_interrupt = WITHOUT_FORCE
    threads.check(args.threads)
    methods = restorers(args.methods, running_options(args))
    refuse_idle(vars(args), methods)
    use_threads(args)
    if args.static is not None:
        return _run_static(args, methods)
    if args.source is None or args.output is None:
        raise ValueError("give a data set or clip folder and -o, or --static COUNTS")
    from quiver.evaluation import summary
    from quiver.evaluation.comparison import evaluate

    with _prepared(args, methods) as (comparison, remarks):
        with bar("rows", "row") as progress:
            rows = evaluate(comparison, methods, args.output, lambda what, done, total: progress(done, total))
        summary.write(args.output, comparison, methods, rows, remarks)
    output(
        args, summary.as_dict(comparison, methods, rows, remarks), summary.markdown(comparison, methods, rows, remarks)
    )
    return 1 if any(row.failure for row in rows) else 0


@contextlib.contextmanager
def _prepared(args: argparse.Namespace, methods: Sequence[Any]) -> Iterator[tuple[Comparison, list[str]]]:
    """Check what `quiver evaluate` scores, then hold the folder of its results; yield the settings and remarks."""
    from quiver.evaluation.comparison import check, streams

    comparison = _comparison(args)
    if comparison.test_set is None:
        check(comparison)
        remarks = check_domain(args, methods, streams(comparison))
        with _folder(args, comparison):
            yield comparison, remarks
        return
    from quiver.data.test_sets import TEST_SETS, counted, describe, import_test_set

    which = TEST_SETS[args.protocol]
    source = Path(args.source)
    described = describe(source, which)
    with _folder(args, comparison):
        with bar("clips", "clip") as progress:
            clips = import_test_set(source, which, Path(comparison.source), progress, described)
        line = counted(clips, which)
        note(line)
        yield comparison, [f"{line}; read from {source}", *check_domain(args, methods, streams(comparison))]


@contextlib.contextmanager
def _folder(args: argparse.Namespace, comparison: Comparison) -> Iterator[None]:
    """Hold the folder of an evaluation, which is made or with --force emptied; `ValueError` if another process does."""
    from quiver.evaluation.comparison import CLIPS, LOCK, check_folder

    check_folder(args.output, comparison, force=args.force)
    args.output.mkdir(parents=True, exist_ok=True)
    lock = Lock(args.output / LOCK)
    if not lock.acquire():
        raise ValueError(f"{args.output}: another process evaluates here; wait for it to end, or choose another -o")
    try:
        if args.force:
            from quiver.data import test_sets

            renew(args.output, "plan.json", f"{OURS}|{CLIPS}/{test_sets.OURS}")
        yield
    finally:
        lock.delete()


def _comparison(args: argparse.Namespace) -> Comparison:
    """Return what `quiver evaluate` scores on the clips of a data set, or on one clip."""
    from quiver.data.illumination import Illumination
    from quiver.evaluation.comparison import Comparison
    from quiver.restoration.sources import LIGHT, refuse

    refuse(args, ("frames", "splits"), "belongs to --static COUNTS")
    _check_source(args)
    check_free(args.output)
    if args.protocol is not None:
        return _published_test(args)
    if (Path(args.source) / "clip.json").exists() and args.split not in (None, "all"):
        raise ValueError(
            f"--split {args.split}: chooses clips of a data set, and {args.source} is one clip; leave it out"
        )
    if args.stream is not None:
        refuse(args, LIGHT, f"stream {args.stream} is stored and has its own")
        if args.published:
            raise ValueError(
                f"--published: is for windows that are exposed now, and stream {args.stream} is stored; leave it out"
            )
    sensor = args.sensor or ("quiver-published" if args.published else "quiver-physical")
    own = sensor.endswith(".toml")  # the file states the bits
    lights = tuple(
        Illumination.of(sensor, ppp, bits)
        for bits in args.bits or ((None,) if own else (3,))
        for ppp in args.ppp or (3.25,)
    )
    split = None if args.split == "all" else args.split or "test"
    return Comparison(args.source, split, lights, args.seed or 0, args.published, args.stream, args.peak)


def _check_source(args: argparse.Namespace) -> None:
    """Raise `ValueError` if --force would remove the source with the imported clips, or a test set would hold them."""
    from quiver.evaluation.comparison import CLIPS

    source = Path(args.source).resolve()
    clips = (args.output / CLIPS).resolve()
    if clips in (source, *source.parents) or (args.protocol is not None and source in clips.parents):
        raise ValueError(
            f"{args.source}: overlaps with {args.output / CLIPS}, which is for imported clips; choose another -o"
        )


def _published_test(args: argparse.Namespace) -> Comparison:
    """Return what is scored on a test set of the paper, whose clips are imported into OUT/clips."""
    from quiver.data.illumination import Illumination
    from quiver.evaluation.comparison import CLIPS, Comparison

    refuse_published(args)
    folder = str(args.output / CLIPS)
    lights = tuple(Illumination.of("quiver-published", ppp, 3) for ppp in args.ppp or (3.25,))
    return Comparison(folder, None, lights, args.seed or 0, published=True, test_set=args.protocol)


def refuse_published(args: argparse.Namespace) -> None:
    """Raise `ValueError` for options that a protocol of the paper decides."""
    from quiver.restoration.sources import refuse

    refuse(args, ("split", "stream", "sensor", "bits", "peak"), f"--protocol {args.protocol} decides it")
    if args.published:
        raise ValueError(f"--published: --protocol {args.protocol} includes it; leave it out")


def _run_static(args: argparse.Namespace, methods: Sequence[Any]) -> int:
    from quiver.data.clips import peak_of
    from quiver.data.photon_counts import read_counts
    from quiver.evaluation.json_values import json_safe
    from quiver.evaluation.static_object import FORMAT, counted, evaluate_static, markdown

    _refuse_for_counts(args)
    if not args.static.is_file():
        raise FileNotFoundError(f"{args.static}: no such file")
    counts = read_counts(args.static)
    bits = (args.bits or (3,))[0]
    frames = args.frames or 11
    check_domain(args, methods, [counted(counts, bits)])
    scores = evaluate_static(
        counts, methods, frames=frames, bits=bits, splits=args.splits or 3, seed=args.seed or 0, peak=args.peak
    )
    found = {"format": FORMAT, "counts": str(args.static), "frames": frames, "bits": bits}
    found["peak"] = peak_of(counts.light, args.peak)
    found["scores"] = [asdict(score) for score in scores]
    output(args, json_safe(found), markdown(counts, scores, frames, bits, args.peak))
    return 1 if any(score.failure for score in scores) else 0


def _refuse_for_counts(args: argparse.Namespace) -> None:
    """Raise `ValueError` for options of `quiver evaluate` without effect on measured counts."""
    from quiver.restoration.sources import refuse

    why = "is for clips, and --static scores measured counts"
    if args.source is not None:
        raise ValueError(f"{args.source}: {why}; leave one of them out")
    refuse(args, ("output", "split", "stream", "sensor", "ppp", "protocol"), why)
    for name in ("published", "force"):
        if getattr(args, name):
            raise ValueError(f"--{name}: {why}; leave it out")
    if args.bits is not None and len(args.bits) > 1:
        raise ValueError("--bits: measured counts are clipped to one depth; give one number")


# bench


def add_bench(sub: Any) -> None:
    parser = command(
        sub,
        "bench",
        _run_bench,
        "Measure what a restored frame costs, beside its PSNR.",
        "quiver bench\n"
        "quiver bench --methods moment,mergenet,quiver-s --modes exact,streaming,windows --size 128x128 -o out/bench",
    )
    parser.add_argument(
        "--methods",
        type=words,
        default="moment,unet,mergenet",
        help="methods, weights, folders of runs, and presets, with random weights unless some ship; comma-separated "
        "(default moment,unet,mergenet)",
    )
    parser.add_argument("--modes", type=words, help="modes of networks (default exact,streaming)")
    parser.add_argument(
        "--precisions", type=words, help="precisions of networks: float32, bfloat16 or both (default float32)"
    )
    parser.add_argument("--size", type=frame_size, default="64x64", help="ROWSxCOLUMNS in px (default 64x64)")
    parser.add_argument("--ppp", type=positive, default=3.25, help="light of the fixed clip (default 3.25)")
    parser.add_argument("--device", choices=DEVICES, help="device of networks (default auto)")
    add_threads(parser, resumed=False)
    parser.add_argument("-o", "--output", type=Path, help="folder for bench.md, bench.json, bench.png")
    parser.add_argument("--force", action="store_true", help="replace an existing result")


def _run_bench(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.evaluation.cost import CostSettings, bench, checked_cases, device_of, figure, markdown
    from quiver.evaluation.json_values import json_safe
    from quiver.training.run_folder import alone_in

    if args.output is None and args.force:
        raise ValueError("--force: replaces a result in -o FOLDER, which is not given; leave it out")
    if args.output is not None:
        check_free(args.output)
    for written in () if args.output is None else ("bench.json", "bench.md", "bench.png"):
        refuse_existing(args.output / written, args.force)
    threads.check(args.threads)
    cases = checked_cases(args.methods, args.modes, args.precisions, args.device)
    height, width = args.size
    with contextlib.ExitStack() as stack:
        if args.output is not None:
            args.output.mkdir(parents=True, exist_ok=True)
            stack.enter_context(alone_in(args.output, "measures"))
        device = device_of(cases, args.device)
        settings = CostSettings(height, width, ppp=args.ppp, device=device, threads=use_threads(args))
        progress = stack.enter_context(bar("cases", "case"))
        costs = bench(cases, settings, progress)
        text = markdown(costs, settings)
        found = json_safe({"setting": asdict(settings), "costs": [asdict(cost) for cost in costs]})
        if args.output is not None:
            write_bytes(args.output / "bench.md", text.encode())
            figure(costs, args.output / "bench.png")
            write_json(args.output / "bench.json", found)
    output(args, found, text)
    return 1 if any(cost.failure for cost in costs) else 0
