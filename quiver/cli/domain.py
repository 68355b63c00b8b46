"""The command `quiver domain`: shows what weights were measured for, or measures it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from qsim.cli.command import Idle, command
from qsim.cli.console import MAKES_AGAIN, RESUMES, bar, output, running
from qsim.kinds import Bits, Light, Seed, Text
from qsim.settings import setting
from quiver.cli.options import Threads, given, use_threads
from quiver.data.illumination import sensor_names
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.settings import method_names


@dataclass(frozen=True)
class DomainOfWeights:
    """The weights, and the clips and lights at which `quiver domain` measures them."""

    weights: Annotated[
        str,
        setting(
            "shipped weights, a .safetensors file, or a folder of `quiver train`", positional=True, known=method_names
        ),
    ]
    clips: Annotated[
        tuple[Path, ...],
        setting("data sets and clip folders that were not used for training or tuning", positional=True),
    ] = ()
    split: Annotated[Literal["train", "val", "test", "all"] | None, setting("split of data sets", unset="test")] = None
    sensor: Annotated[
        tuple[Text, ...] | None,
        setting("names or .toml files, comma-separated", unset="quiver-physical", known=sensor_names),
    ] = None
    bits: Annotated[
        tuple[Bits, ...] | None, setting("bits per code, comma-separated", unset="3; of a .toml file its own")
    ] = None
    ppp: Annotated[
        tuple[Light, ...] | None, setting("mean photons per pixel and code, comma-separated", unset="3.25")
    ] = None
    methods: Annotated[
        tuple[Text, ...] | None,
        setting(
            "classical methods, comma-separated",
            unset="naive, moment:3, transform-denoise, qbp, qbp-bm3d",
            known=method_names,
        ),
    ] = None
    seed: Annotated[Seed | None, setting("seed of the noise", unset="0")] = None
    classical_of: Annotated[
        str | None,
        setting("measured weights whose classical scores are taken", unset="all are measured", known=method_names),
    ] = None
    force: Annotated[bool, setting("measure existing cells again")] = False


MEASURING = ("split", "sensor", "bits", "ppp", "methods", "seed", "memory", "mode", "device", "precision", "threads")
IDLE = (
    Idle(
        lambda asked, *_: "" if asked.clips else "is for measuring, and no clips are given",
        (*MEASURING, "classical_of", "force"),
    ),
    Idle(
        lambda asked, *_: (
            "chooses clips of data sets, and only clip folders are given"
            if asked.clips and all((clips / "clip.json").exists() for clips in asked.clips)
            else ""
        ),
        ("split",),
    ),
)


@command(
    "quiver domain mergenet",
    "quiver domain out/mine out/data --bits 1,3 --ppp 1,3.25,10",
    "quiver domain out/mine out/data --sensor spad-320x240 --bits 1 --ppp 0.3,1,3",
    after_interrupt=RESUMES,
    idle=IDLE,
)
def domain(asked: DomainOfWeights, options: RestoreOptions, limit: Threads) -> int:
    """Measure the cells that are missing, or print those that the weights hold."""
    from quiver import threads
    from quiver.model.weights import load, metadata_of
    from quiver.restoration.domain import TIE, Domain, forget_damaged, read_scope, table
    from quiver.restoration.networks import network_restorer
    from quiver.restoration.restorers import weights_path
    from quiver.restoration.sources import refuse_idle

    if asked.force:
        running().after_interrupt = MAKES_AGAIN

    path = weights_path(asked.weights)
    if asked.clips:
        from quiver.evaluation.domain_measurement import measure

        threads.check(limit.threads)
        settings = _settings(asked)
        if asked.force:
            forget_damaged(path)
        refuse_idle(given(options), [network_restorer(path, options)])
        use_threads(limit.threads)
        with bar("cells", "cell") as progress:
            rivals = None if asked.classical_of is None else weights_path(asked.classical_of)
            found: Domain | None = measure(path, settings, options, progress, force=asked.force, classical_of=rivals)
    else:
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
    output({"weights": str(path), "domain": found.to_dict()}, text)
    return 0


def _settings(asked: DomainOfWeights) -> Any:
    from quiver.data.illumination import Illumination
    from quiver.evaluation.domain_measurement import CLASSICAL, DomainSettings, clips_of

    lights = tuple(
        Illumination.of(sensor, ppp, bits)
        for sensor in asked.sensor or ("quiver-physical",)
        for bits in asked.bits or (_own_bits(sensor),)
        for ppp in asked.ppp or (3.25,)
    )
    clips = clips_of(asked.clips, None if asked.split == "all" else asked.split or "test")
    return DomainSettings(clips, lights, asked.methods or CLASSICAL, asked.seed or 0)


def _own_bits(sensor: str) -> int:
    """Return the bits of a sensor file, else 3."""
    from quiver.data.illumination import read_sensor

    return read_sensor(sensor)[0].bits if sensor.endswith(".toml") else 3
