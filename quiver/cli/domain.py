"""The command `quiver domain`: shows what weights were measured for, or measures it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.cli.console import MAKES_AGAIN, bar, output
from qsim.cli.options import checked, numbers, whole_numbers, words
from quiver.cli.options import add_running, command, running_options, use_threads

MEASURING = ("split", "sensor", "bits", "ppp", "methods", "seed", "memory", "mode", "device", "precision", "threads")


def add_domain(sub: Any) -> None:
    parser = command(
        sub,
        "domain",
        _run_domain,
        "Measure where weights are better than the classical methods and store it in their file, or show it.",
        "quiver domain mergenet\n"
        "quiver domain out/mine out/data --bits 1,3 --ppp 1,3.25,10\n"
        "quiver domain out/mine out/data --sensor spad-320x240 --bits 1 --ppp 0.3,1,3",
        resumes=True,
    )
    parser.add_argument("weights", help="shipped weights, a .safetensors file, or a folder of `quiver train`")
    parser.add_argument(
        "clips", nargs="*", type=Path, help="data sets and clip folders that were not used for training or tuning"
    )
    parser.add_argument("--split", choices=("train", "val", "test", "all"), help="split of data sets (default test)")
    parser.add_argument("--sensor", type=words, help="names or .toml files, comma-separated (default quiver-physical)")
    parser.add_argument(
        "--bits", type=whole_numbers, help="bits per code, comma-separated (default 3; of a .toml file its own)"
    )
    parser.add_argument("--ppp", type=numbers, help="mean photons per pixel and code, comma-separated (default 3.25)")
    parser.add_argument(
        "--methods",
        type=words,
        help="classical methods, comma-separated (default naive, moment:3, transform-denoise, qbp, qbp-bm3d)",
    )
    parser.add_argument("--seed", type=checked(checks.seed), help="seed of the noise (default 0)")
    add_running(parser, resumed=False)
    parser.add_argument("--force", action="store_true", help="measure existing cells again")


def _run_domain(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.model.weights import load, metadata_of
    from quiver.restoration.domain import TIE, Domain, forget_damaged, read_scope, table
    from quiver.restoration.networks import network_restorer
    from quiver.restoration.restorers import weights_path
    from quiver.restoration.sources import refuse, refuse_idle

    if args.force:
        args.after_interrupt = MAKES_AGAIN

    path = weights_path(args.weights)
    if args.clips:
        from quiver.evaluation.domain_measurement import measure

        threads.check(args.threads)
        options = running_options(args)
        settings = _settings(args)
        if args.force:
            forget_damaged(path)
        refuse_idle(vars(args), [network_restorer(path, options)])
        use_threads(args)
        with bar("cells", "cell") as progress:
            found: Domain | None = measure(path, settings, options, progress, force=args.force)
    else:
        refuse(args, MEASURING, "is for measuring, and no clips are given")
        if args.force:
            raise ValueError("--force: is for measuring, and no clips are given; leave it out")
        load(path)  # names a damaged file
        found = read_scope(path, metadata_of(path)).domain
    if found is None:
        raise ValueError(f"{path}: was never measured; give clips that were not used for training or tuning")
    wins = sum(cell.wins for cell in found.cells)
    text = [
        *table(found),
        "",
        f"{path.name}: at least as good as the best classical method in {wins} of {len(found.cells)} cells (up to "
        f"{TIE:g} dB less is a tie)",
    ]
    output(args, {"weights": str(path), "domain": found.to_dict()}, text)
    return 0


def _settings(args: argparse.Namespace) -> Any:
    from quiver.data.illumination import Illumination
    from quiver.evaluation.domain_measurement import CLASSICAL, DomainSettings, clips_of

    lights = tuple(
        Illumination.of(sensor, ppp, bits)
        for sensor in args.sensor or ("quiver-physical",)
        for bits in args.bits or (_own_bits(sensor),)
        for ppp in args.ppp or (3.25,)
    )
    if args.split is not None and all((clips / "clip.json").exists() for clips in args.clips):
        raise ValueError(
            f"--split {args.split}: chooses clips of data sets, and only clip folders are given; leave it out"
        )
    clips = clips_of(args.clips, None if args.split == "all" else args.split or "test")
    return DomainSettings(clips, lights, args.methods or CLASSICAL, args.seed or 0)


def _own_bits(sensor: str) -> int:
    """Return the bits of a sensor file, else 3."""
    from quiver.data.illumination import read_sensor

    return read_sensor(sensor)[0].bits if sensor.endswith(".toml") else 3
