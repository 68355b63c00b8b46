"""Defines `Clip`: a clip folder with the streams and events that were drawn from it, as notebooks use it.

clip = qsim.render("fan", frames=21)
stream = clip.sense("quiver-physical", ppp=3.25, bits=3)
clip[5], stream[5]      one frame: radiance, codes
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from qsim import colour as pictures
from qsim import files
from qsim.clip import exr
from qsim.clip.clip_folder import ClipFolder
from qsim.clip.clip_info import RELATIVE
from qsim.clip.film import Film, card
from qsim.files import Progress
from qsim.host import own_numbers
from qsim.keys import hash_name
from qsim.kinds import Text
from qsim.sensor.sensor import Sensor
from qsim.settings import taking
from qsim.streams.event_sensing import EventSensing, sense_events
from qsim.streams.event_stream import FOLDER, EventStream
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from qsim.streams.stream import Stream


@dataclass(frozen=True)
class _Asked(Sensing):
    """What `Clip.sense` takes: the settings of a stream, with a sensor to begin with, and how it is made."""

    sensor: Text | Sensor = "quiver-physical"
    force: bool = field(default=False, kw_only=True)
    progress: Progress | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class _AskedEvents(EventSensing):
    """What `Clip.sense_events` takes: the settings of events, and how they are made."""

    force: bool = field(default=False, kw_only=True)
    progress: Progress | None = field(default=None, kw_only=True)


@own_numbers
@dataclass(frozen=True, eq=False)
class Clip(ClipFolder):
    """A complete clip folder and its streams; frames are read on demand."""

    def __repr__(self) -> str:
        frames, height, width = self.shape
        unit = "(relative)" if self.info.radiance_unit == RELATIVE else "W/m2/sr"
        streams = ", ".join(self.streams) or "none"
        unit += "" if self.bands is None else " in each of 3 bands"
        return (
            f"<Clip {self.name}: {frames} frames of {height} x {width} px at {self.frame_rate:g} fps, exposure "
            f"{self.exposure * 1e6:.4g} us, mean radiance {self.mean_radiance:.4g} {unit}, streams: {streams}>"
        )

    def _repr_html_(self) -> str:
        """Return the middle frame and the facts of `repr`, for notebooks."""
        middle = self.radiance(len(self) // 2)
        return card(repr(self), pictures.tone_picture(middle, pictures.peak(middle), colours=self.bands is not None))

    def show(self, start: int = 0, stop: int | None = None, fps: float = 12.0) -> Film:
        """Return the radiance of frames start ... stop - 1 (at most 100 by default) as a film that notebooks show.

        `fps` is the speed of the film, in frames per second.
        """
        return Film.of(self.name, self._frames, start, stop, fps)

    @taking(_Asked)
    def sense(self, asked: _Asked) -> Stream:
        """Return the codes of a sensor that sees this clip; the stream is stored in the clip's folder.

        `sensor` is a record such as `QIS(...)`, a name of `qsim doctor --devices`, or a .toml file. `ppp` is the mean
        of photons per pixel and code over the clip, `lux` [lx] the light at 555 nm instead; with neither, the clip's
        own light is used. `pixel_pitch` [m] lets a clip without a camera have lux. A colour clip needs colour filters,
        as in `colour="rggb"`. `Sensing` describes the other settings. A stream of equal settings is not drawn
        again; `force` replaces one of other settings. `progress(done, total)` is called as codes are drawn.
        `ValueError` for settings that do not fit the clip; `FileExistsError` where `name` is taken by others.
        """
        wanted = Sensing(**{each.name: getattr(asked, each.name) for each in fields(Sensing)})
        return self.stream(sense(self, wanted, force=asked.force, progress=asked.progress)[0].name)

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the streams sensed from this clip."""
        return tuple(sorted(path.stem for path in (self.path / "streams").glob("*.json")))

    def stream(self, name: str) -> Stream:
        """Open a stream by its name; `FileNotFoundError` lists the existing ones."""
        path = self.path / "streams" / f"{name}.json"
        if not path.is_file():
            known = ", ".join(self.streams) or "none yet; make one with `qsim sense`"
            raise FileNotFoundError(f"{self.path}: no stream {name!r}; there are: {known}")
        found = replace(Stream.open(path), keeps=self.keeps)
        self._check_drawn_here(found)
        return found

    def _check_drawn_here(self, stream: Stream | EventStream) -> None:
        """Raise `ValueError` for a stream that was drawn from another clip: a folder of streams that was copied."""
        if stream.info.clip_key not in (None, hash_name(self.name)):
            raise ValueError(
                f"{stream.path}: was drawn from the clip {stream.info.clip!r}, and this one is {self.name!r}; take it "
                "away, and draw a stream here with `qsim sense`"
            )

    @taking(_AskedEvents)
    def sense_events(self, asked: _AskedEvents) -> EventStream:
        """Return the events that an event camera reports of this clip; they are stored in the clip's folder.

        `camera` is an `EventCamera`, dvs, dvs-ideal, or a .toml file. `ppp` is the mean of photons per pixel and clip
        frame, `lux` [lx] the light at 555 nm instead; with neither, the clip's own light is used. Events of equal
        settings are not drawn again; `force` replaces those of other settings. `progress(done, total)` is called after
        each frame. `ValueError` for settings that do not fit the clip, and for colour clips; `FileExistsError` where
        `name` is taken by others.
        """
        wanted = EventSensing(**{each.name: getattr(asked, each.name) for each in fields(EventSensing)})
        return self.event_stream(sense_events(self, wanted, force=asked.force, progress=asked.progress)[0].name)

    @property
    def event_streams(self) -> tuple[str, ...]:
        """Names of the events drawn from this clip."""
        return tuple(sorted(path.stem for path in (self.path / FOLDER).glob("*.json")))

    def event_stream(self, name: str) -> EventStream:
        """Open events by their name; `FileNotFoundError` lists the existing ones."""
        path = self.path / FOLDER / f"{name}.json"
        if not path.is_file():
            known = ", ".join(self.event_streams) or "none yet; make some with `qsim events`"
            raise FileNotFoundError(f"{self.path}: no events {name!r}; there are: {known}")
        found = replace(EventStream.open(path), keeps=self.keeps)
        self._check_drawn_here(found)
        return found

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Return one message per file whose checksum or size differs; empty if the clip is intact.

        `progress(done, total)` is called after each file; a stream counts as one.
        """
        problems = []
        stored = sorted(self.info.checksums.items())
        opened: list[tuple[Path, Callable[[str], Stream | EventStream]]] = [
            (path, self.stream) for path in sorted((self.path / "streams").glob("*.json"))
        ]
        opened += [(path, self.event_stream) for path in sorted((self.path / FOLDER).glob("*.json"))]
        report = progress or (lambda done, total: None)
        total = len(stored) + len(opened)
        for done, (relative, expected) in enumerate(stored, 1):
            problems += files.differs(self.path / relative, expected, exr.largest(*self.shape[1:]), self.path)
            report(done, total)
        for done, (path, open_it) in enumerate(opened, len(stored) + 1):
            try:
                problems += open_it(path.stem).verify()
            except (ValueError, OSError) as error:
                problems.append(files.wording(error))
            report(done, total)
        return problems
