"""Recipes: one TOML file -> the jobs of a data set. Strict: every mistake is named with file, line and key.

    [recipe]
    name = "starter"           # letters, digits, '.', '_', '-'
    frames = 21                # per clip
    height = 128               # pixels
    width = 128
    frame_rate = 2000.0        # frames per second of the scene's time
    shutter = 0.0              # open share of a frame, 0..1; 0: a sharp instant with the light of a whole frame
    psnr = 40.0                # wanted error of the radiance, dB
    seed = 0                   # of the samples and of the noise

    [[scenes]]                 # one clip per family, seed and speed
    family = "fan"             # a family of scenes/; or beside the recipe a .py or .xml file, or a folder ("./things")
    seeds = [0, 1, 2]          # or: count = 3 (seeds first ... first + count - 1; first = 0)
    speed = [1.0, 2.0]         # factor on all motions, a number or a list; default 1
    split = "train"            # train, val or test
    # frames, height, width, frame_rate, shutter, psnr: as above, for these scenes only

    [[streams]]                # optional; one stream per bits and light level, in every clip
    sensor = "quiver-physical" # a name of `qsim doctor --devices`, or a .toml file beside the recipe
    bits = 3                   # or a list
    ppp = [3.25, 26.0]         # photons per pixel and code over the whole clip; or lux = ...; or absolute = true
    # seed = 1, name = "...", group = true (codes sum clip frames as binary planes), diffraction = true

Splits are by scene: a (family, seed) belongs to one split, whatever its speed, and a family of the test split occurs in
no other split.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.files import to_json
from qsim.footage import MAX_PIXELS
from qsim.stream import Sensing, check_name

SPLITS = checks.SPLITS


@dataclass(frozen=True)
class Settings:
    """How a clip is rendered."""

    frames: int
    height: int  # pixels
    width: int  # pixels
    frame_rate: float  # Hz
    shutter: float = 0.0  # open share of a frame
    psnr: float = 40.0  # dB, wanted error of the radiance


@dataclass(frozen=True)
class Job:
    """One clip with its streams: a pure description; the same job gives the same files."""

    name: str
    family: str
    scene_seed: int
    speed: float
    split: str
    settings: Settings
    seed: int
    streams: tuple[Sensing, ...]

    @property
    def stem(self) -> str:
        """The family's name without folder and ending."""
        return Path(self.family).stem

    @property
    def scene(self) -> str:
        """What splits are made by: family and seed."""
        return f"{self.stem}:{self.scene_seed}"

    @property
    def digest(self) -> str:
        """SHA-256 of everything that decides the job's files."""
        described = dataclasses.asdict(self) | {"family": Path(self.family).stem}
        described["streams"] = [stream | {"sensor": Path(stream["sensor"]).name} for stream in described["streams"]]
        for stream in described["streams"]:  # what is off stays out, so that data sets of earlier versions go on
            for key, off in (("defects", None), ("slices", 1)):
                if stream[key] == off:
                    del stream[key]
        return hashlib.sha256(to_json(described)).hexdigest()


@dataclass(frozen=True)
class Recipe:
    """A data set to be made."""

    name: str
    jobs: tuple[Job, ...]
    source: dict[str, Any]  # the TOML file's content, as written

    @property
    def splits(self) -> dict[str, list[str]]:
        """Split -> names of its clips."""
        return {split: [job.name for job in self.jobs if job.split == split] for split in SPLITS}


def load(path: str | Path) -> Recipe:
    """`FileNotFoundError`, or `ValueError` as `FILE:LINE: what is wrong, what to do`."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such recipe")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file; a recipe is TOML in UTF-8") from None
    return parse(text, path)


def parse(text: str, path: Path = Path("recipe.toml")) -> Recipe:
    """A recipe from the text of a TOML file; `path` names it in errors and is where relative files are looked for."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"at line (\d+)", str(error))
        line = found[1] if found else len(text.splitlines())  # else the parser says "at end of document"
        raise ValueError(f"{path}:{line}: not valid TOML: {error}") from None
    return _Reader(text, path).recipe(content)


class _Reader:
    """Turns parsed TOML into a `Recipe`; keeps the text to say in which line a mistake is."""

    def __init__(self, text: str, path: Path) -> None:
        self.lines = text.splitlines()
        self.path = path

    def recipe(self, content: dict[str, Any]) -> Recipe:
        self.known(content, ("recipe", "scenes", "streams"), "the recipe", None, 0)
        if not isinstance(content.get("recipe"), dict):
            raise ValueError(f"{self.path}: the section [recipe] is missing")
        head = content["recipe"]
        self.known(head, ("name", "seed", *_SETTINGS), "[recipe]", "recipe", 0)
        for key in ("name", "frames", "height", "width", "frame_rate"):
            if key not in head:
                raise ValueError(f"{self.where('recipe', 0)}: key '{key}' is missing in [recipe]")
        name = self.value(head, "name", checks.text, "recipe", 0)
        seed = self.value(head, "seed", checks.seed, "recipe", 0) if "seed" in head else 0
        defaults = {key: self.value(head, key, check, "recipe", 0) for key, check in _SETTINGS.items() if key in head}
        streams: list[Sensing] = []
        for i, table in self.tables(content, "streams"):
            streams += self.streams(table, i, seed, {stream.stream_name for stream in streams})
        jobs: list[Job] = []
        sections: list[int] = []  # of the jobs
        for i, table in self.tables(content, "scenes"):
            jobs += self.jobs(table, i, defaults, seed, tuple(streams))
            sections += [i] * (len(jobs) - len(sections))
        if not jobs:
            raise ValueError(f"{self.path}: no [[scenes]], nothing to render")
        self.check_jobs(jobs, sections)
        return Recipe(name, tuple(jobs), content)

    def check_jobs(self, jobs: list[Job], sections: list[int]) -> None:
        """No clip twice, no scene in two splits, no family of the test split in another one, frames for every sum."""
        seen: set[str] = set()
        split_of: dict[str, str] = {}
        tested = {job.stem for job in jobs if job.split == "test"}
        for job, i in zip(jobs, sections, strict=True):
            where = self.where("scenes", i)
            if job.name in seen:
                raise ValueError(f"{where}: the clip {job.name} is asked for twice; give one of them other seeds")
            seen.add(job.name)
            if split_of.setdefault(job.scene, job.split) != job.split:
                raise ValueError(
                    f"{where}: scene {job.scene} is in the splits '{split_of[job.scene]}' and '{job.split}'; splits "
                    "are by scene, whatever the speed: give one of them other seeds"
                )
            if job.split != "test" and job.stem in tested:
                raise ValueError(
                    f"{where}: family {job.stem} is in the splits '{job.split}' and 'test'; the test split holds "
                    "families that training never sees: move its scenes"
                )
            for sensing in job.streams:
                if sensing.group and job.settings.frames < 2 ** (sensing.bits or 1) - 1:
                    raise ValueError(
                        f"{where}: {job.settings.frames} frames are too few for {sensing.stream_name}, whose codes "
                        f"sum {2 ** (sensing.bits or 1) - 1} of them"
                    )

    def jobs(
        self, table: dict[str, Any], i: int, defaults: dict[str, Any], seed: int, streams: tuple[Sensing, ...]
    ) -> list[Job]:
        self.known(
            table, ("family", "seeds", "count", "first", "speed", "split", *_SETTINGS), "[[scenes]]", "scenes", i
        )
        if "family" not in table:
            raise ValueError(f"{self.where('scenes', i)}: key 'family' is missing in [[scenes]]")
        family = self.family(table, i)
        seeds = self.seeds(table, i)
        speeds = self.value(table, "speed", checks.list_of(checks.speed), "scenes", i) if "speed" in table else [1.0]
        split = self.value(table, "split", checks.split, "scenes", i) if "split" in table else "train"
        own = {key: self.value(table, key, check, "scenes", i) for key, check in _SETTINGS.items() if key in table}
        settings = Settings(**(defaults | own))
        if settings.height * settings.width > MAX_PIXELS:
            raise ValueError(
                f"{self.where('scenes', i)}: frames of {settings.height} x {settings.width} pixels; at most "
                f"{MAX_PIXELS} pixels are rendered"
            )
        stem = Path(family).stem
        return [
            Job(
                name=f"{stem}_{s:04d}" + ("" if speed == 1 else f"_x{speed:g}"),
                family=family,
                scene_seed=s,
                speed=speed,
                split=split,
                settings=settings,
                seed=seed,
                streams=streams,
            )
            for s in seeds
            for speed in speeds
        ]

    def family(self, table: dict[str, Any], i: int) -> str:
        family: str = self.value(table, "family", checks.text, "scenes", i)
        file = (self.path.parent / family).resolve()
        if "/" in family and file.is_dir():
            return str(file)
        if family.endswith((".py", ".xml")):
            if not file.is_file():
                raise ValueError(f"{self.where('scenes', i, 'family')}: no such scene file {file}")
            return str(file)
        from scenes import FAMILIES

        if family not in FAMILIES:
            known = ", ".join(sorted(FAMILIES))
            raise ValueError(
                f"{self.where('scenes', i, 'family')}: unknown family {family!r}{_suggest(family, FAMILIES)}; "
                f"there are: {known}"
            )
        return family

    def seeds(self, table: dict[str, Any], i: int) -> list[int]:
        if "seeds" in table:
            for key in ("count", "first"):
                if key in table:
                    raise ValueError(f"{self.where('scenes', i, key)}: give either seeds or count, not both")
            return list(self.value(table, "seeds", checks.list_of(checks.seed), "scenes", i))
        first = self.value(table, "first", checks.seed, "scenes", i) if "first" in table else 0
        count = self.value(table, "count", checks.whole, "scenes", i) if "count" in table else 1
        return list(range(first, first + count))

    def streams(self, table: dict[str, Any], i: int, seed: int, taken: set[str]) -> list[Sensing]:
        keys = ("sensor", "bits", "ppp", "lux", "absolute", "seed", "name", "group", "diffraction")
        self.known(table, keys, "[[streams]]", "streams", i)
        if "sensor" not in table:
            raise ValueError(f"{self.where('streams', i)}: key 'sensor' is missing in [[streams]]")
        lights = [key for key in ("ppp", "lux", "absolute") if key in table]
        if len(lights) != 1:
            given = " and ".join(lights) if lights else "none"
            raise ValueError(
                f"{self.where('streams', i)}: give one light level, ppp = ..., lux = ... or absolute = true; "
                f"{given} given"
            )
        bits = self.value(table, "bits", checks.list_of(checks.bits), "streams", i) if "bits" in table else [None]
        group, diffraction = (
            key in table and self.value(table, key, checks.flag, "streams", i) for key in ("group", "diffraction")
        )
        sensor = self.sensor(table, i, bits, group)
        own = self.value(table, "seed", checks.seed, "streams", i) if "seed" in table else seed
        levels: list[float | None] = [None]
        if lights != ["absolute"]:
            levels = self.value(table, lights[0], checks.list_of(checks.light), "streams", i)
        elif self.value(table, "absolute", checks.flag, "streams", i) is not True:
            raise ValueError(f"{self.where('streams', i, 'absolute')}: absolute can only be true; or give a ppp")
        name = self.value(table, "name", checks.text, "streams", i) if "name" in table else None
        if name is not None and len(bits) * len(levels) > 1:
            raise ValueError(f"{self.where('streams', i, 'name')}: one name for {len(bits) * len(levels)} streams")
        found = [
            Sensing(
                sensor,
                bits=b,
                ppp=level if lights == ["ppp"] else None,
                lux=level if lights == ["lux"] else None,
                seed=own,
                name=name,
                group=group,
                diffraction=diffraction,
            )
            for b in bits
            for level in levels
        ]
        names = [stream.stream_name for stream in found]
        for n, stream in enumerate(names):
            if stream in taken or stream in names[:n]:
                raise ValueError(
                    f"{self.where('streams', i)}: two [[streams]] are called '{stream}'; give one of them a name"
                )
        return found

    def sensor(self, table: dict[str, Any], i: int, bits: list[int | None], group: bool) -> str:
        """The sensor's name or file, if it exists with all these bits, and its planes can be summed where asked."""
        from qsim import devices
        from qsim.spad import BinarySPAD

        sensor: str = self.value(table, "sensor", checks.text, "streams", i, plain=False)
        where = self.where("streams", i, "sensor")
        if sensor.endswith(".toml"):
            sensor = str((self.path.parent / sensor).resolve())
        for depth in bits:
            try:
                found = devices.load(sensor, ppp=3.25, bits=depth, exposure=5e-4)
            except (ValueError, OSError) as error:
                raise ValueError(f"{where}: {error}") from None
            if group and not (depth and isinstance(found, BinarySPAD)):
                what = f"this is a {type(found).__name__}" if depth else "the bits of a code are needed, as in bits = 3"
                raise ValueError(f"{self.where('streams', i, 'group')}: group sums planes of a clocked SPAD; {what}")
        return sensor

    def tables(self, content: dict[str, Any], key: str) -> list[tuple[int, dict[str, Any]]]:
        tables = content.get(key, [])
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            raise ValueError(f"{self.where(key, 0)}: '{key}' must be sections, each beginning with [[{key}]]")
        return list(enumerate(tables))

    def known(self, table: dict[str, Any], keys: tuple[str, ...], where: str, section: str | None, i: int) -> None:
        for key in table:
            if key not in keys:
                raise ValueError(
                    f"{self.where(section, i, key)}: unknown key '{key}' in {where}{_suggest(key, keys)}; "
                    f"known are {', '.join(keys)}"
                )

    def value(
        self, table: dict[str, Any], key: str, check: Callable[[Any], Any], section: str, i: int, plain: bool = True
    ) -> Any:
        try:
            value = check(table[key])
            return check_name(value) if plain and key == "name" else value
        except ValueError as error:
            raise ValueError(f"{self.where(section, i, key)}: {key}: {error}") from None

    def where(self, section: str | None, i: int, key: str | None = None) -> str:
        """`FILE:LINE` of a key in the i-th section of that name (of the section's head without a key)."""
        number, inside, seen = 0, section is None, -1
        for n, line in enumerate(self.lines, 1):
            head = re.match(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?", line)
            if head:
                seen += head[1] == section
                inside = head[1] == (key if section is None else section) and (section is None or seen == i)
                if inside:
                    number = n
                    if key is None or section is None:
                        break
            elif inside and key is not None and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*[=.]", line):
                number = n
                break
        return f"{self.path}:{number or self.mention(section, key)}"

    def mention(self, section: str | None, key: str | None) -> int:
        """The first line that says `key =`, or else the section, for tables written in line or with dots."""
        for word in (key, section):
            for n, line in enumerate(self.lines, 1):
                if word and re.search(rf"(?<![\w-]){re.escape(word)}[\"']?\s*[=.]", line):
                    return n
        return 1


def _suggest(word: str, known: Any) -> str:
    close = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


_SETTINGS: dict[str, Callable[[Any], Any]] = {
    "frames": checks.whole,
    "height": checks.whole,
    "width": checks.whole,
    "frame_rate": checks.frame_rate,
    "shutter": checks.shutter,
    "psnr": checks.psnr,
}
