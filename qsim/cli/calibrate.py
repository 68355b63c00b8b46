"""Runs `qsim calibrate`: measures a sensor from dark and flat frames and writes its file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from qsim.cli.command import Idle, command
from qsim.cli.console import output, refuse_existing
from qsim.formats.recording import Hints, Layout
from qsim.kinds import Bits, Positive
from qsim.plane_sums import PlaneSums
from qsim.settings import setting

COUNTS = 8  # bits; larger codes of a SPAD may be sums of planes, which the user must state


@dataclass(frozen=True)
class Calibrate:
    """The frames that `qsim calibrate` measures, and what they are; the facts of its files are a `Layout`."""

    output: Annotated[Path, setting(".toml to write; .json and .png beside it", short="o")]
    dark: Annotated[
        tuple[tuple[str, ...], ...],
        setting("frames without light, and their exposure", shown="FILE SECONDS", several="repeated"),
    ] = ()
    flat: Annotated[
        tuple[tuple[str, ...], ...],
        setting(
            "evenly lit frames, their exposure, and the photons per pixel if known",
            shown="FILE SECONDS [PHOTONS]",
            several="repeated",
        ),
    ] = ()
    static: Annotated[
        tuple[Path, Positive] | None,
        setting(
            "counts of a static scene: measures the dead time from Fano factors",
            shown="FILE SECONDS",
            several="following",
        ),
    ] = None
    bits: Annotated[
        Bits | None,
        setting(
            "bits per code; 1 for binary planes", unset="needed, unless planes are summed, by --planes or --summed"
        ),
    ] = None
    model: Annotated[
        Literal["qis", "spad"] | None, setting("kind of sensor", unset="qis; spad with --planes or --summed")
    ] = None
    own_pixels: Annotated[
        bool,
        setting("spad: the file gives every pixel its measured dark counts, and fits no larger frames"),
    ] = False
    paralyzable: Annotated[bool, setting("spad: every arrival restarts the dead time")] = False
    ignore_dead_time: Annotated[bool, setting("spad: model the counts as Poisson")] = False
    force: Annotated[bool, setting("replace existing files")] = False


def _kind(asked: Calibrate, sums: PlaneSums) -> str:
    """Return the kind of sensor: as given, else as the frames say."""
    of_planes = sums.planes is not None or sums.summed is not None
    return asked.model or ("spad" if asked.static or of_planes else "qis")


def _planes(sums: PlaneSums) -> int:
    """Return the binary planes in a value."""
    return sums.planes or sums.summed or 1


def _is_packed(layout: Layout) -> bool:
    """Return whether --width states the packed planes of .npy files, not the size of raw frames."""
    return layout.layout in (None, "cube")


_NO_DEAD_TIME = "binary planes have no dead time in this model"
IDLE = (
    Idle(
        lambda asked, *_: "the static scene of --static replaces dark and flat frames" if asked.static else "",
        ("dark", "flat"),
    ),
    Idle(
        lambda asked, *_: (
            "a qis has no dead time for --static to find" if asked.static and asked.model == "qis" else ""
        ),
        ("model",),
    ),
    Idle(
        lambda asked, *_: (
            "a QIS is calibrated from its own codes; for sums of binary planes add --model spad"
            if asked.model == "qis"
            else ""
        ),
        ("planes", "summed"),
    ),
    Idle(
        lambda asked, _, sums: (
            "binary planes have no dead time for --static to find" if _planes(sums) > 1 and asked.static else ""
        ),
        ("planes", "summed"),
    ),
    Idle(
        lambda asked, _, sums: (
            ""
            if _kind(asked, sums) == "spad" and not asked.static
            else "it is for --model spad with dark and flat frames"
        ),
        ("ignore_dead_time",),
    ),
    Idle(
        lambda asked, _, sums: "" if _kind(asked, sums) == "spad" else "it is for --model spad and --static",
        ("paralyzable",),
    ),
    Idle(
        lambda asked, _, sums: (
            "" if _kind(asked, sums) == "spad" and asked.dark else "it is for --model spad with dark frames"
        ),
        ("own_pixels",),
    ),
    Idle(lambda asked, *_: "--ignore-dead-time takes no dead time" if asked.ignore_dead_time else "", ("paralyzable",)),
    Idle(
        lambda asked, _, sums: (
            f"sums of {_planes(sums)} planes have bits of their own" if _planes(sums) > 1 and asked.bits != 1 else ""
        ),
        ("bits",),
    ),
    Idle(
        lambda asked, _, sums: (
            "single planes have 1 bit, and --summed says that values are sums of several"
            if (sums.summed or 1) > 1 and asked.bits == 1
            else ""
        ),
        ("bits",),
    ),
    Idle(
        lambda asked, *_: "the counts of --static are used as a whole" if asked.static else "",
        ("start", "stop", "every"),
    ),
    Idle(
        lambda asked, _, sums: _NO_DEAD_TIME if _planes(sums) > 1 or asked.bits == 1 else "",
        ("ignore_dead_time", "paralyzable"),
    ),
    Idle(
        lambda asked, layout, _: (
            "it is for packed binary planes, and counts are read one by one"
            if _is_packed(layout) and asked.static
            else ""
        ),
        ("width",),
    ),
    Idle(
        lambda asked, layout, _: (
            f"it is for packed binary planes, and --bits is {asked.bits}"
            if _is_packed(layout) and (asked.bits or 1) > 1
            else ""
        ),
        ("width",),
    ),
)


@command(
    "qsim calibrate --bits 8 --dark d1.npy 1e-3 --dark d2.npy 0.1 --flat f.npy 1e-3 --flat g.npy 1e-3 -o my.toml",
    "qsim calibrate --model spad --bits 1 --dark dark.npy 1e-5 --flat flat.npy 1e-5 0.8 -o spad.toml",
    "qsim calibrate --bits 8 --static counts.npy 6.33e-6 -o counter.toml",
    idle=IDLE,
)
def calibrate(asked: Calibrate, layout: Layout, sums: PlaneSums) -> int:
    """Measure the sensor, write its files and print its numbers."""
    from qsim.calibration import sensor_file
    from qsim.calibration.qis import calibrate_qis
    from qsim.calibration.spad import calibrate_spad

    if asked.output.suffix != ".toml":
        raise ValueError(f"{asked.output}: the sensor file is a .toml, as in -o my_sensor.toml")
    model, bits = _calibration_kind(asked, sums)
    _check_outputs(asked, model)
    darks = [_stack(words, asked, layout, sums, dark=True) for words in asked.dark]
    flats = [_stack(words, asked, layout, sums, dark=False) for words in asked.flat]
    if asked.static:
        found = _static(asked, layout, bits)
    elif model == "qis":
        found = calibrate_qis(darks, flats, bits=bits)
    else:
        found = calibrate_spad(
            darks, flats, bits=bits, dead_time=not asked.ignore_dead_time, paralyzable=asked.paralyzable
        )
    asked.output.parent.mkdir(parents=True, exist_ok=True)
    stacks = f"{len(darks)} dark and {len(flats)} flat stacks"
    origin = f"counts of the static scene {asked.static[0].name}" if asked.static else stacks
    written = sensor_file.write(found, asked.output, f"calibrated from {origin}", own_pixels=asked.own_pixels)
    width = max(len(name) for name in found.values)
    assumed = _assumed(asked, sums, model, bits)
    files = [words[0] for words in (*asked.dark, *asked.flat)]
    rates = {name: stack.rates for name, stack in zip(files, (*darks, *flats), strict=True)} if not asked.static else {}
    text = [f"taken as: {assumed}", *(f"{name}: {words}" for name, words in rates.items())]
    text += [f"{name:{width}}  {value}  ({value.method})" for name, value in found.values.items()]
    text += [f"warning: {words}" for words in found.warnings]
    text += ["written: " + ", ".join(str(path) for path in written)]
    told = {"assumed": assumed, "rates": rates, "files": [str(path) for path in written]}
    output(sensor_file.as_dict(found) | told, text)
    return 0


def _check_outputs(asked: Calibrate, model: str) -> None:
    """Raise an `OSError` if a file to write exists without --force, is an input, or lies beside as another's."""
    from qsim.calibration.sensor_file import beside, holds_values, stream_of

    written = beside(asked.output)
    if not (model == "spad" and asked.dark):
        written.pop("dark_count_rate")
        written.pop("hot_pixels")
    inputs = [Path(words[0]) for words in (*asked.dark, *asked.flat)]
    inputs += [asked.static[0]] if asked.static else []
    inputs += [path.with_suffix(end) for path in inputs if stream_of(path) is not None for end in (".npy", ".json")]
    for path in (asked.output, *written.values()):
        places = (path, *path.resolve().parents) if path.exists() else ()
        for given in inputs:
            if given.exists() and any(place.samefile(given) for place in places):
                raise FileExistsError(f"{path}: would replace a file of the input {given}; name another with -o")
        refuse_existing(path, asked.force)
    there = [path for path in written.values() if path.exists()]
    if there and not holds_values(written["values"]):
        raise FileExistsError(f"{there[0]}: was not written by a calibration; move it away, or name another with -o")


def _calibration_kind(asked: Calibrate, sums: PlaneSums) -> tuple[str, int]:
    """Return (qis or spad, bits of a code); `ValueError` if they are not stated."""
    if asked.bits is None and _planes(sums) == 1:
        raise ValueError("--bits: is needed, as in --bits 8; for sums of N binary planes give --summed N instead")
    bits = asked.bits or 1
    kind = _kind(asked, sums)
    if kind == "spad" and bits > COUNTS and sums.summed is None and not asked.static:
        raise ValueError(
            f"--bits {bits}: values this large may be sums of binary planes; give --summed N for sums of N planes, or "
            "--summed 1 if every value counts one exposure"
        )
    return kind, bits


def _assumed(asked: Calibrate, sums: PlaneSums, model: str, bits: int) -> str:
    """Return a line that states how the numbers in the files are interpreted."""
    if _planes(sums) > 1:
        made = ", made of single planes" if sums.summed is None else ""
        return f"sums of {_planes(sums)} binary planes of a SPAD{made}; seconds and photons are those of one plane"
    if asked.static:
        return f"counts of one exposure each, {bits} bits, of a static scene"
    if model == "spad" and bits > 1:
        return f"counts of one exposure each, {bits} bits (for sums of N binary planes: --summed N)"
    return f"{'binary planes of a SPAD' if model == 'spad' else f'{bits}-bit codes of a QIS'}"


def _static(asked: Calibrate, layout: Layout, bits: int) -> Any:
    from qsim.calibration.dead_time import calibrate_static
    from qsim.calibration.sensor_file import read_counts

    assert asked.static is not None
    path, exposure = asked.static
    counts = read_counts(path, _hints_of(layout), bits, exposure)
    return calibrate_static(counts, bits=bits, exposure=exposure, paralyzable=asked.paralyzable, name=str(path))


def _hints_of(layout: Layout) -> Hints:
    """Return the facts of a reader that a layout states."""
    return Hints(**vars(layout))


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{word!r} is not a number; give seconds, as in 1e-3") from None


def _stack(words: tuple[str, ...], asked: Calibrate, layout: Layout, sums: PlaneSums, *, dark: bool) -> Any:
    from qsim.calibration.sensor_file import read_stack

    kind = "--dark" if dark else "--flat"
    most = 2 if dark else 3
    if not 2 <= len(words) <= most:
        raise ValueError(
            f"{kind} {' '.join(words)}: give a file and its exposure in seconds, as in {kind} frames.npy 1e-3"
        )
    numbers = [_number(word) for word in words[1:]]
    stated = numbers[1] if len(numbers) > 1 else None
    photons = 0.0 if dark else stated
    return read_stack(
        Path(words[0]),
        bits=asked.bits or 1,
        exposure=numbers[0],
        photons=photons,
        hints=_hints_of(layout),
        sums=sums,
    )
