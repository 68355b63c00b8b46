"""Builds the parser of the command `quiver`, and runs a command line."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

from qsim.cli.completion import add_completion, sensors
from qsim.cli.console import Parser, output, run
from qsim.files import VERSION
from quiver.cli.domain import add_domain
from quiver.cli.evaluate import add_bench, add_evaluate
from quiver.cli.options import command, handling
from quiver.cli.restore import add_restore
from quiver.cli.train import add_ablate, add_train
from quiver.device import out_of_memory


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line and return the exit code."""
    from quiver.threads import wait_without_spinning

    wait_without_spinning()
    with handling(signal.default_int_handler, signal.SIGTERM):  # termination cleans up as Ctrl-C does
        return run(parser(), argv)


def parser() -> Parser:
    """Return the parser of all commands."""
    program = Parser(
        prog="quiver", description="Restore blur-free video from few-bit quanta streams; train and compare."
    )
    program.add_argument("--version", action="version", version=f"quiver {VERSION}")
    sub = program.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for add in (add_train, add_restore, add_evaluate, add_domain, add_ablate, add_bench, _add_convert_weights):
        add(sub)
    for one in sub.choices.values():
        one.set_defaults(run=_within_memory(one.get_default("run")))
    several = {"--methods": lambda: [*_methods(), "all"]}
    add_completion(sub, program, {"--sensor": sensors, "--method": _methods, "weights": _methods} | several)
    return program


def _within_memory(action: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """Return a command that says in one sentence that memory is exhausted; torch raises a `RuntimeError`."""

    def run_command(args: argparse.Namespace) -> int:
        try:
            return action(args)
        except RuntimeError as error:
            if not out_of_memory(error):
                raise
            option = next((name for name in ("batch", "memory") if hasattr(args, name)), "size")
            output = getattr(args, "output", None)
            kept = output is not None and Path(f"{Path(output).resolve()}.part.json").exists()
            more = ", which may start again; or free some, and the same command resumes" if kept else ""
            raise ValueError(
                f"memory is exhausted ({shorten(str(error), 100)}); give a smaller --{option}{more}"
            ) from error

    return run_command


# convert-weights


def _methods() -> list[str]:
    """Return the methods that need no training, for shells to complete."""
    from quiver.restoration.restorers import method_names

    return method_names()


def _add_convert_weights(sub: Any) -> None:
    parser = command(
        sub,
        "convert-weights",
        _run_convert_weights,
        "Turn a checkpoint of the published network into ours.",
        "quiver convert-weights quiver.pth -o out/quiver.safetensors",
    )
    parser.add_argument("source", type=Path, help="checkpoint (.pt, .pth, .ckpt, .safetensors); never unpickled")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".safetensors to write")
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def _run_convert_weights(args: argparse.Namespace) -> int:
    from quiver.model.published_weights import convert_weights
    from quiver.restoration.domain import UP_TO_A_FACTOR

    if args.output.suffix != ".safetensors":
        raise ValueError(f"{args.output}: weights are written as .safetensors; name a .safetensors file with -o")
    if args.force and args.output.exists():
        _check_ours(args.output)
    network = convert_weights(args.source, args.output, force=args.force)
    parameters = sum(p.numel() for p in network.parameters())
    found = {"weights": str(args.output), "channels": network.config.channels, "parameters": parameters}
    size = f"{network.config.channels} channels, {parameters:,} parameters"
    output(args, found, f"{args.output}: {size}; {UP_TO_A_FACTOR}")
    return 0


def _check_ours(path: Path) -> None:
    """Raise `FileExistsError` for a file that does not hold weights of this program."""
    from quiver.model.weights import FORMAT, metadata_of

    try:
        ours = metadata_of(path).get("format") == FORMAT
    except (OSError, ValueError):
        ours = False
    if not ours:
        raise FileExistsError(
            f"{path}: does not hold weights of this program, and --force replaces nothing else; name another with -o"
        )
