"""Runs `quiver convert-weights`: turns a checkpoint of the published network into ours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from qsim.cli.command import command
from qsim.cli.console import output
from qsim.settings import setting


@dataclass(frozen=True)
class ConvertWeights:
    """The checkpoint, and the weights that are written."""

    source: Annotated[Path, setting("checkpoint (.pt, .pth, .ckpt, .safetensors); never unpickled", positional=True)]
    output: Annotated[Path, setting(".safetensors to write", short="o")]
    force: Annotated[bool, setting("replace an existing file")] = False


@command("quiver convert-weights quiver.pth -o out/quiver.safetensors")
def convert(asked: ConvertWeights) -> int:
    """Write the weights and print the size of the network."""
    from quiver.model.published_weights import convert_weights
    from quiver.restoration.domain import UP_TO_A_FACTOR

    if asked.output.suffix != ".safetensors":
        raise ValueError(f"{asked.output}: weights are written as .safetensors; name a .safetensors file with -o")
    if asked.force and asked.output.exists():
        _check_ours(asked.output)
    network = convert_weights(asked.source, asked.output, force=asked.force)
    parameters = sum(p.numel() for p in network.parameters())
    found = {"weights": str(asked.output), "channels": network.config.channels, "parameters": parameters}
    size = f"{network.config.channels} channels, {parameters:,} parameters"
    output(found, f"{asked.output}: {size}; {UP_TO_A_FACTOR}")
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
