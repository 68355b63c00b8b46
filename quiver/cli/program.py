"""The command `quiver`: parse, call, print. Each command is a pair `_add_X` (options) and `_run_X` (what it does);
`train` and `ablate` are in cli_train.py.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from qsim.cli.completion import add_completion
from qsim.cli.console import Parser, bar, note, output, run
from qsim.files import VERSION, write_bytes, write_json
from quiver.cli.domain import add_domain
from quiver.cli.options import (
    add_light,
    add_running,
    add_strict,
    add_threads,
    command,
    count,
    handling,
    height_width,
    positive,
    renew,
    running_options,
    use_threads,
    words,
)
from quiver.cli.train import add_ablate, add_train
from quiver.restoration.interface import DEFAULT_METHOD


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    from quiver.threads import wait_without_spinning

    wait_without_spinning()
    parser = Parser(
        prog="quiver", description="Restore blur-free video from few-bit quanta streams; train and compare."
    )
    parser.add_argument("--version", action="version", version=f"quiver {VERSION}")
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for add in (add_train, _add_restore, _add_evaluate, add_domain, add_ablate, _add_bench, _add_convert_weights):
        add(sub)
    add_completion(sub, parser)
    with handling(signal.default_int_handler, signal.SIGTERM):  # termination cleans up like Ctrl-C
        return run(parser, argv)


# restore


def _add_restore(sub: Any) -> None:
    parser = command(
        sub, "restore", _run_restore, "Restore a stream, a clip or a photon cube; no ground truth is needed.",
        "quiver restore out/starter/clips/fan_0003 -o out/fan.npy\n"
        "quiver restore out/fan/streams/quiver-physical_3bit_3.25ppp.npy -o out/fan.npy --method out/mine\n"
        "quiver restore out/fan --ppp 3.25 -o out/fan.npy --method moment\n"
        "quiver restore cube.npy --width 320 --planes 7 --sensor spad-320x240 --frame-rate 1428 -o out/cube.npy",
        goes_on=True,
    )  # fmt: skip
    parser.add_argument("source", type=Path, help="stream (.npy with its .json), clip folder, or bare .npy array")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".npy to write; a .json appears beside it")
    parser.add_argument(
        "--method",
        default=DEFAULT_METHOD,
        help=f"classical method, shipped weights, file or run (default {DEFAULT_METHOD})",
    )
    parser.add_argument("--stream", help="which stream of a clip (default: the only one)")
    add_light(parser, several=False)
    parser.add_argument("--seed", type=int, help="of the noise, where a clip is sensed now (default 0)")
    parser.add_argument("--width", type=count, help="bare array: packed binary planes of this many pixels per row")
    parser.add_argument("--planes", type=count, help="packed planes: 2^b - 1 are summed to one code (default 1)")
    parser.add_argument("--frame-rate", type=positive, help="bare array: codes per second (default 2000)")
    add_running(parser)
    add_strict(parser)
    parser.add_argument("--force", action="store_true", help="replace an existing result")


def _run_restore(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.restoration.restored_file import restore_to_file
    from quiver.restoration.restorers import restorer
    from quiver.restoration.sources import assumed, codes_to_restore, refuse_idle

    target: Path = args.output
    if target.suffix != ".npy":
        raise ValueError(f"{target}: restored video is written as .npy; name a file that ends so")
    codes = codes_to_restore(args)
    for path in (target, target.with_suffix(".json")):
        if path.exists() and not args.force:
            raise FileExistsError(f"{path}: exists; name another with -o, or use --force to replace it")
    threads.check(args.threads)
    method = restorer(args.method, running_options(args))
    refuse_idle(vars(args), [method])
    _check_domain(args, [method], [codes])
    used = use_threads(args, threads.recorded(target.with_name(f"{target.name}.part.json")))
    target.parent.mkdir(parents=True, exist_ok=True)
    lines, started = [assumed(codes, method)], time.monotonic()
    with bar(method.name) as progress:

        def shown(done: int, total: int) -> None:
            while lines and time.monotonic() > started + 2:  # as the bar: a mistake is one line without it
                note(lines.pop())
            progress(done, total)

        meta = restore_to_file(codes, method, target, shown, force=args.force, note=note, threads=used)
    for line in lines:
        note(line)
    length, height, width = codes.shape
    output(
        args,
        {"restored": str(target)} | meta,
        f"{target}: {length} frames of {height} x {width} by {method.name}, "
        f"{meta['seconds_per_frame']:.3g} s per frame; photons, white = {codes.white:.4g}",
    )
    return 0


def _check_domain(args: argparse.Namespace, methods: Sequence[Any], streams: Iterable[Any]) -> list[str]:
    """A line on stderr for each network outside of what it was measured for; `ValueError` with --strict."""
    from quiver.restoration.domain_remarks import measured_at, refuse_outside, remarks

    found: list[str] = []
    for codes in streams:
        found += [text for text in remarks(methods, codes) if text not in found]
        if args.strict:
            refuse_outside(methods, found)
        if args.verbose:
            for text in filter(None, (measured_at(method, codes) for method in methods)):
                note(f"quiver: {text}")
    for text in found:
        note(f"quiver: warning: {text}")
    return found


# evaluate


def _add_evaluate(sub: Any) -> None:
    parser = command(
        sub, "evaluate", _run_evaluate, "Compare methods on held-out clips, or on real photons of a static object.",
        "quiver evaluate out/starter -o out/table --methods naive,moment,out/mine,out/unet --ppp 3.25,9.75,26\n"
        "quiver evaluate out/starter/clips/fan_0003 -o out/fan_table --methods moment,nano --split all\n"
        "quiver evaluate --static hazelnut_gates6_TKYX_uint8.npy --methods moment,nano", goes_on=True,
    )  # fmt: skip
    parser.add_argument("source", nargs="?", help="data set or clip folder")
    parser.add_argument("-o", "--output", type=Path, help="folder for evaluation.md, .json, .png (needed for clips)")
    parser.add_argument(
        "--methods", type=words, default="naive,moment", help="with commas; window as in moment:3; all = all"
    )
    parser.add_argument("--split", choices=("train", "val", "test", "all"), help="of a data set (default test)")
    parser.add_argument("--stream", help="score this stored stream of every clip instead of sensing now")
    add_light(parser, several=True)
    parser.add_argument("--seed", type=int, help="of the test noise or of the random splits (default 0)")
    parser.add_argument("--published", action="store_true", help="every window exposed, scaled and scored on its own")
    parser.add_argument(
        "--peak", type=positive, help="photons per pixel that the scores refer to (default 2.5 x the mean light)"
    )
    parser.add_argument(
        "--static", type=Path, metavar="COUNTS", help="photon counts [N,H,W] or [T,K,H,W], .npy or .npz"
    )
    parser.add_argument("--frames", type=count, help="static: frames to restore from (default 11)")
    parser.add_argument("--splits", type=count, help="static: random splits (default 3)")
    add_running(parser)
    add_strict(parser)
    parser.add_argument("--force", action="store_true", help="start again where an evaluation is")


def _run_evaluate(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.restoration.restorers import restorers
    from quiver.restoration.sources import refuse_idle

    threads.check(args.threads)
    methods = restorers(args.methods, running_options(args))
    refuse_idle(vars(args), methods)
    use_threads(args)
    if args.static is not None:
        return _run_static(args, methods)
    if args.source is None or args.output is None:
        raise ValueError("give a data set or clip folder and -o, or --static COUNTS")
    from quiver.evaluation import summary
    from quiver.evaluation.comparison import evaluate, streams
    from quiver.restoration.sources import plan_of

    plan = plan_of(args)
    remarks = _check_domain(args, methods, streams(plan))
    if args.force and args.output.exists():
        renew(
            args.output,
            "plan.json",
            r"plan\.json|rows\.jsonl|evaluation\.(json|md|png)|crops_[^/]*\.png|crops/[^/]*\.npy|lock",
        )
    with bar("rows", "row") as progress:
        rows = evaluate(plan, methods, args.output, lambda what, done, total: progress(done, total))
    summary.write(args.output, plan, methods, rows, remarks)
    output(args, summary.as_dict(plan, methods, rows, remarks), summary.markdown(plan, methods, rows, remarks))
    return 1 if any(row.failure for row in rows) else 0


def _run_static(args: argparse.Namespace, methods: Sequence[Any]) -> int:
    from quiver.data.clips import peak_of
    from quiver.data.photon_counts import read_counts
    from quiver.evaluation.comparison import json_safe
    from quiver.evaluation.static_object import FORMAT, counted, evaluate_static, markdown
    from quiver.restoration.sources import refuse_for_counts

    refuse_for_counts(args)
    if not args.static.is_file():
        raise FileNotFoundError(f"{args.static}: no such file")
    counts = read_counts(args.static)
    bits, frames = (args.bits or (3,))[0], args.frames or 11
    _check_domain(args, methods, [counted(counts, bits)])
    scores = evaluate_static(
        counts, methods, frames=frames, bits=bits, splits=args.splits or 3, seed=args.seed or 0, peak=args.peak
    )
    found = {"format": FORMAT, "counts": str(args.static), "frames": frames, "bits": bits}
    found["peak"] = peak_of(counts.light, args.peak)
    found["scores"] = [asdict(score) for score in scores]
    output(args, json_safe(found), markdown(counts, scores, frames, bits, args.peak))
    return 1 if any(score.failure for score in scores) else 0


# bench


def _add_bench(sub: Any) -> None:
    parser = command(
        sub, "bench", _run_bench, "Measure what a restored frame costs, beside its PSNR.",
        "quiver bench\n"
        "quiver bench --methods moment,nano,quiver-s --modes exact,streaming,windows --size 128x128 -o out/bench",
    )  # fmt: skip
    parser.add_argument(
        "--methods", type=words, default="moment,unet,nano", help="with commas (default moment,unet,nano)"
    )
    parser.add_argument("--modes", type=words, help="of networks (default exact,streaming)")
    parser.add_argument("--precisions", type=words, help="of networks: float32, bfloat16 or both (default float32)")
    parser.add_argument("--size", type=height_width, default="64x64", help="HEIGHTxWIDTH in px (default 64x64)")
    parser.add_argument("--ppp", type=positive, default=3.25, help="light of the fixed clip (default 3.25)")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), help="of networks (default auto)")
    add_threads(parser)
    parser.add_argument("-o", "--output", type=Path, help="folder for bench.md, bench.json, bench.png")
    parser.add_argument("--force", action="store_true", help="replace an existing result")


def _run_bench(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.evaluation.comparison import json_safe
    from quiver.evaluation.cost import Setting, bench, checked_cases, figure, markdown
    from quiver.training.run_folder import alone_in

    if args.output is None and args.force:
        raise ValueError("--force: replaces a result in -o FOLDER, which is not given; leave it out")
    if args.output is not None and (args.output / "bench.json").exists() and not args.force:
        raise FileExistsError(
            f"{args.output / 'bench.json'}: exists; name another with -o, or use --force to replace it"
        )
    threads.check(args.threads)
    cases = checked_cases(args.methods, args.modes, args.precisions, args.device)
    height, width = args.size
    with contextlib.ExitStack() as stack:
        if args.output is not None:
            args.output.mkdir(parents=True, exist_ok=True)
            stack.enter_context(alone_in(args.output, "measures"))
        device = args.device or "auto"
        setting = Setting(height, width, ppp=args.ppp, device=device, threads=use_threads(args))
        progress = stack.enter_context(bar("cases", "case"))
        costs = bench(cases, setting, progress)
        text = markdown(costs, setting)
        found = json_safe({"setting": asdict(setting), "costs": [asdict(cost) for cost in costs]})
        if args.output is not None:
            write_bytes(args.output / "bench.md", text.encode())
            figure(costs, args.output / "bench.png")
            write_json(args.output / "bench.json", found)
    output(args, found, text)
    return 1 if any(cost.failure for cost in costs) else 0


# convert-weights


def _add_convert_weights(sub: Any) -> None:
    parser = command(
        sub, "convert-weights", _run_convert_weights, "Turn a checkpoint of the published network into ours.",
        "quiver convert-weights quiver.pth -o out/quiver.safetensors",
    )  # fmt: skip
    parser.add_argument("source", type=Path, help="checkpoint (.pt, .pth, .ckpt, .safetensors); never unpickled")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".safetensors to write")
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def _run_convert_weights(args: argparse.Namespace) -> int:
    from quiver.model.weights import convert_weights

    if args.force and args.output.exists():
        fresh = args.output.with_name(f".{args.output.stem}.new.safetensors")
        fresh.unlink(missing_ok=True)
        network = convert_weights(args.source, fresh)
        os.replace(fresh, args.output)
    else:
        network = convert_weights(args.source, args.output)
    parameters = sum(p.numel() for p in network.parameters())
    found = {"weights": str(args.output), "channels": network.config.channels, "parameters": parameters}
    output(args, found, f"{args.output}: {network.config.channels} channels, {parameters:,} parameters")
    return 0
