"""Runs `qsim sense`: draws few-bit streams of clips, or draws one frame again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from qsim.cli.command import Idle, command
from qsim.cli.console import MAKES_AGAIN, bar, note, output, running
from qsim.kinds import Text
from qsim.settings import setting, settings_of
from qsim.streams import storing
from qsim.streams.sensing import Sensing
from qsim.streams.stream import Stream
from qsim.streams.stream_info import StreamInfo


@dataclass(frozen=True)
class Sense:
    """The clips that `qsim sense` draws streams of; what it draws are the `Sensing`."""

    paths: Annotated[tuple[Path, ...], setting("clips or data sets", shown="PATH", positional=True)]
    replay: Annotated[
        Text | None, setting("draw one frame again and compare it with the stored one", shown="CLIP:FRAME")
    ] = None
    force: Annotated[bool, setting("replace a stream of the same name")] = False


def _several(asked: Sense, wanted: Sequence[Sensing]) -> str:
    return f"is of one stream, not of {len(wanted)} light levels" if len(wanted) > 1 else ""


def _replayed(asked: Sense, wanted: Sequence[Sensing]) -> str:
    return "changes nothing, as --replay draws what is stored" if asked.replay else ""


def _named(asked: Sense, wanted: Sequence[Sensing]) -> str:
    return f"changes nothing in a replay of --name {wanted[0].name}" if asked.replay and wanted[0].name else ""


NAMED = ("sensor", "bits", "planes", "ppp", "lux", "colour", "seed")  # the settings that make the name of a stream
IDLE = (
    Idle(lambda asked, wanted: "is what --planes does" if wanted[0].planes else "", ("group",)),
    Idle(_several, ("name", "replay")),
    Idle(
        _replayed,
        (*(one.name for one in settings_of(Sensing) if one.name not in (*NAMED, "name")), "force"),
    ),
    Idle(_named, NAMED),
)


@command(
    "qsim sense out/fan --bits 3 --ppp 3.25",
    "qsim sense out/starter --sensor spad-320x240 --bits 1 --ppp 0.5,3.25,26",
    "qsim sense out/starter --name quiver-physical_3bit_3.25ppp --replay fan_0003:7",
    after_interrupt="the same command resumes with the missing streams",
    threads="threads of the compiled engine (Dr.Jit) that draws codes; codes do not depend on it",
    idle=IDLE,
)
def sense(asked: Sense, wanted: Annotated[tuple[Sensing, ...], {"sensor": "quiver-physical"}]) -> int:
    """Draw the streams that are missing, or one frame again."""
    if asked.force:
        running().after_interrupt = MAKES_AGAIN
    clips = [clip for path in asked.paths for clip in clips_of(path)]
    if asked.replay:
        return _replay(asked, clips, wanted[0])
    made = []
    lines = []
    for clip, (found, line), drawn in drawings(clips, wanted, partial(storing.sense, force=asked.force), "sensing"):
        facts = {"clip": str(clip.path), "stream": found.name, "file": str(found.path), "made": drawn}
        made.append({**facts, "light": line, "rates": found.rates, **_light(found.info)})
        lines.append(f"{'wrote' if drawn else 'exists already:'} {found.path}: {_codes(found)}; {line}")
    if len(wanted) > 1:
        note("streams of a clip with the same --seed share their random numbers: another --seed makes them independent")
    output({"streams": made}, lines)
    return 0


def drawings(
    clips: Sequence[Any], wanted: Sequence[Any], draw: Callable[..., tuple[Any, str]], title: str
) -> Iterator[tuple[Any, tuple[Any, str], bool]]:
    """Draw what is missing of every clip by every setting, with a bar; yield (clip, what `draw` returns, drawn now)."""
    frames = sum(len(clip) for clip in clips) * len(wanted)
    before: int = 0
    with bar(title) as progress:
        for clip in clips:
            for sensing in wanted:
                drawn: list[int] = []

                def count(done: int, _: int, start: int = before, drawn: list[int] = drawn) -> None:
                    drawn.append(done)
                    progress(start + done, frames)

                waiting = partial(note, f"{clip.path}: waiting for another process that works on this clip")
                found = draw(clip, sensing, progress=count, on_wait=waiting)
                before += len(clip)
                yield clip, found, bool(drawn)


def _codes(made: Stream) -> str:
    """Return what a stream holds, as in `21 codes of 3 bits, 128 x 128 pixels, RATES`."""
    frames, height, width = made.shape
    return f"{frames} codes of {made.bits} bit{'s' if made.bits > 1 else ''}, {height} x {width} pixels, {made.rates}"


def _light(info: StreamInfo) -> dict[str, object]:
    """Return what `--json` states of a stream that was drawn."""
    assert info.light is not None
    levels = {"ppp": info.light.ppp, "ppp_factor": info.light.factor, "mean_photons_before": info.light.before}
    facts = {"equivalent_lux_555nm": info.light.lux, "bits": info.bits, "shape": list(info.shape)}
    return levels | facts | {"code_model": info.code_model}


def _replay(asked: Sense, clips: list[Any], sensing: Sensing) -> int:
    assert asked.replay is not None
    name, _, number = asked.replay.rpartition(":")
    if not number.isdigit() or (not name and len(clips) != 1):
        raise ValueError(f"--replay {asked.replay}: expected CLIP:FRAME, as in fan_0003:7")
    chosen = [clip for clip in clips if not name or clip.name == name]
    if not chosen:
        raise ValueError(f"--replay {asked.replay}: no clip {name} among {', '.join(clip.name for clip in clips)}")
    clip = chosen[0]
    known = clip.streams
    named = running().given.intersection(NAMED)
    if len(known) > 1 and not sensing.name and not named and sensing.stream_name not in known:
        raise ValueError(f"{clip.path}: choose one of its streams with --name: {', '.join(known)}")
    stored = clip.stream(known[0] if len(known) == 1 and not sensing.name and not named else sensing.stream_name)
    drawn, kept = storing.replay(clip, stored, int(number))
    differ = int((drawn != kept).sum())
    found = {"clip": clip.name, "stream": stored.name, "frame": int(number), "pixels": drawn.size, "differ": differ}
    verdict = (
        "equal to the stored frame" if differ == 0 else f"{differ} of {drawn.size} pixels DIFFER from the stored frame"
    )
    output(found, f"{clip.name}, {stored.name}, frame {number} drawn again: {verdict}")
    return 0 if differ == 0 else 1


def clips_of(path: Path) -> list[Any]:
    """Return the clips of a data set, or the one clip of a folder."""
    from qsim.dataset.dataset import Dataset
    from qsim.streams.clip import Clip

    if (path / "dataset.json").is_file():
        clips = Dataset.open(path).clips()
        if not clips:
            raise ValueError(f"{path}: this data set has no finished clip yet; run `qsim generate`")
        return list(clips)
    return [Clip.open(path)]
