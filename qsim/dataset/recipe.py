"""Reads a recipe, one TOML file, into the jobs of a data set; errors name file and place, as in `scenes[0].seeds[1]`.

    [recipe]
    name = "starter"
    frames = 21
    height = 128
    width = 128

    [[scenes]]                 # one clip per family, seed and speed
    family = "fan"
    seeds = [0, 1, 2]          # or a range, "0..999999"
    split = "train"

    [[streams]]                # optional; one stream per bits and light level, in every clip
    sensor = "quiver-physical"
    bits = [1, 3]
    ppp = [3.25, 26.0]

The keys are declared in recipe_file.py; `qsim recipes --keys` lists them. Keys of [recipe] may stand in [[scenes]], for
these scenes alone.

A (family, seed) belongs to one split at every speed, and a family of the test split to no other split.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qsim import checks, files, opening, plugins, records
from qsim.clip.clip_folder import ClipFolder
from qsim.clip.clip_info import ClipInfo
from qsim.dataset.job import Job
from qsim.dataset.jobs import Jobs, JobSeries
from qsim.dataset.recipe_file import Head, RecipeFile, ScenesSection, StreamsKeys, StreamsSection
from qsim.dataset.series import LARGEST_SEED, seed_numbers
from qsim.dataset.splits import check_sections
from qsim.optics.radiometry import RGB
from qsim.parsing import parse_toml
from qsim.rendering.render_settings import RenderSettings
from qsim.scene.animated.gltf_body import GLTF_SUFFIXES, animated_file, animations_in
from qsim.scene.animated.gltf_scene import cameras_in
from qsim.scene.camera_path import PLAIN, read_camera_path
from qsim.settings import settings_of
from qsim.streams.preparation import prepare
from qsim.streams.sensing import Sensing, filters_of

SPLITS = checks.SPLITS
MAX_STEM = 180  # characters of a scene's name, which gets a seed, a speed and a temporary ending as a file's name


@dataclass(frozen=True)
class Recipe:
    """Description of a data set: its name and jobs, which may be given one by one."""

    name: str
    jobs: Jobs
    source: RecipeFile | None = None  # as it was written

    def __post_init__(self) -> None:
        if not isinstance(self.jobs, Jobs):
            object.__setattr__(self, "jobs", Jobs.of(self.jobs))

    @property
    def splits(self) -> dict[str, list[str]]:
        """Return the names of the clips of each split."""
        parts = self.jobs.by_section()
        return {split: [name for part in parts if part[0].split == split for name in part.names()] for split in SPLITS}

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the series and of the chosen indices: equal for equal jobs in equal order."""
        series = [records.plain(each) for each in self.jobs.listing.series]
        chosen = [(part.start, part.stop, part.step) for part in self.jobs.chosen]
        return files.sha256(files.to_json([series, chosen]))


def load(path: str | Path) -> Recipe:
    """Read a recipe, a file or the name of a shipped one; errors as `text_of`, or `FILE: place: error, remedy`."""
    found, text = text_of(path)
    return parse(text, found)


def text_of(path: str | Path) -> tuple[Path, str]:
    """Return the file of a recipe, also of the name of a shipped one, and its text.

    `FileNotFoundError`, or `ValueError` for a file that is not text.
    """
    from qsim.scenes import FAMILIES, RECIPES

    found = Path(path)
    if not found.is_file():
        if str(path) in FAMILIES:
            raise FileNotFoundError(f"{path}: is a scene family, not a recipe; use `qsim render {path}`")
        if str(path) not in RECIPES:
            known = ", ".join(RECIPES)
            raise FileNotFoundError(
                f"{path}: no such recipe{checks.suggest(str(path), RECIPES)}; give a .toml file, or one of {known}"
            )
        found = RECIPES[str(path)]
    return found, opening.text(found, "recipe")


def parse(text: str, path: Path = Path("recipe.toml")) -> Recipe:
    """Return the recipe in the text of a TOML file; errors name `path`, and relative files are beside it."""
    source = records.convert(parse_toml(path, text), RecipeFile, str(path))
    seed = source.recipe.seed or 0
    streams = _streams_of(source, seed, path)
    sections: list[JobSeries] = []
    for n, section in enumerate(source.scenes):
        with _place(path, f"scenes[{n}]"):
            sections.append(_jobs_of(section, source.recipe, seed, tuple(streams), path.parent))
    if not sections:
        raise ValueError(f"{path}: no [[scenes]], nothing to render")
    with _place(path, ""):
        check_sections(sections)
    _check_streams(sections, streams, path)
    return Recipe(source.recipe.name, Jobs(sections), source)


@contextlib.contextmanager
def _place(path: Path, place: str) -> Iterator[None]:
    """Put file and place, as in `scenes[1]`, before the message of an error."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise ValueError(": ".join(part for part in (str(path), place, str(error)) if part)) from None


def _jobs_of(section: ScenesSection, head: Head, seed: int, streams: tuple[Sensing, ...], beside: Path) -> JobSeries:
    """Return the jobs of a section [[scenes]], one per seed and speed."""
    from qsim import scenes

    settings = _settings_of(section, head, beside)
    family = _family(section.family, beside)
    scenes.check_view(family, settings.camera, settings.start)
    if family.endswith(GLTF_SUFFIXES):
        _check_gltf(family, settings)
    speeds = tuple(_several(section.speed, "speed"))
    if family.endswith(".xml") and speeds != (1.0,) and settings.camera_path is None:
        raise ValueError("an .xml scene has no motion, so speed changes nothing; leave it out")
    stem = Path(family).stem
    seeds = _seeds(section)
    try:
        files.check_name(f"{stem}_{seeds[0]:04d}")
    except ValueError as error:
        raise ValueError(f"family: clips are named after the scene: {error}") from None
    if len(stem) > MAX_STEM:
        long = f"whose name has {len(stem)} characters; at most {MAX_STEM}"
        raise ValueError(f"family: clips are named after the scene, {long}")
    example = Job(
        family=family,
        scene_seed=seeds[0],
        speed=speeds[0],
        split=section.split,
        settings=settings,
        seed=seed,
        streams=streams,
    )
    return JobSeries(example, seeds, speeds)


def _settings_of(section: ScenesSection, head: Head, beside: Path) -> RenderSettings:
    """Return the settings of a section, else those of [recipe]; a camera path beside the recipe is read as a check."""
    names = [setting.name for setting in settings_of(RenderSettings)]
    given = {name: getattr(part, name) for part in (head, section) for name in names if getattr(part, name) is not None}
    if "camera_path" in given:
        file = (beside / given["camera_path"]).resolve()
        try:
            read_camera_path(file, frame_rate=1.0, size=(PLAIN.height, PLAIN.width))
        except (ValueError, OSError) as error:
            raise ValueError(f"camera_path: {error}") from None
        given["camera_path"] = str(file)
    return RenderSettings(**given)


def _several(value: Any, name: str) -> Sequence[Any]:
    """Return one value, a list of different ones or a range as a sequence."""
    if isinstance(value, range):
        return value
    values = value if isinstance(value, tuple) else (value,)
    seen = set()
    for item in values:
        if item in seen:
            raise ValueError(f"{name}: {item!r} is listed twice")
        seen.add(item)
    return values


def _seeds(section: ScenesSection) -> Sequence[int]:
    """Return the seeds of a section, listed or counted."""
    if section.seeds is not None:
        if section.count is not None or section.first is not None:
            raise ValueError("give either seeds or count, not both")
        return _several(seed_numbers(section.seeds), "seeds")
    first = section.first or 0
    count = 1 if section.count is None else section.count
    if first + count - 1 > LARGEST_SEED:
        raise ValueError(f"seeds {first} to {first + count - 1}; the largest is 2^31 - 1")
    return range(first, first + count)


def _family(family: str, beside: Path) -> str:
    """Return a family of the library, or the absolute path of an existing scene file or folder."""
    file = (beside / family).resolve()
    if "/" in family and file.is_dir():
        return str(file)
    if family.endswith((".py", ".xml", *GLTF_SUFFIXES)):
        if not file.is_file():
            raise ValueError(f"family: no such scene file {file}")
        return str(file)
    from qsim.scenes import FAMILIES

    if family not in FAMILIES:
        meant = f"{family!r}{checks.suggest(family, FAMILIES)}; there are: {', '.join(sorted(FAMILIES))}"
        raise ValueError(f"unknown family {meant}")
    return family


def _check_gltf(file: str, settings: RenderSettings) -> None:
    """Read a glTF file as its scenes will; errors as of its readers."""
    from qsim import scenes

    if cameras_in(file):
        scenes.load(file, camera=settings.camera, start=settings.start)
        return
    names: list[str | None] = [*animations_in(file)]
    for name in names or [None]:
        animated_file(file, animation=name)


def _streams_of(source: RecipeFile, seed: int, path: Path) -> dict[Sensing, str]:
    """Return the streams of all sections [[streams]] with their places, one per bits and light level."""
    streams: dict[Sensing, str] = {}
    taken: set[str] = set()
    for n, section in enumerate(source.streams):
        where = f"streams[{n}]"
        with _place(path, where):
            for sensing in _sensings_of(section, seed, path.parent):
                try:
                    name = sensing.stream_name
                except ValueError as error:
                    raise ValueError(f"sensor: streams are named after the sensor: {error}") from None
                if name in taken:
                    raise ValueError(f"two [[streams]] are called '{name}'; give one of them a name")
                taken.add(name)
                streams[sensing] = where
    return streams


def _sensings_of(section: StreamsSection, seed: int, beside: Path) -> list[Sensing]:
    """Return one stream per bits and light level of a section; `ValueError` if sensor or filters cannot be read."""
    units = [unit for unit in StreamsKeys.LIGHT if getattr(section, unit) is not None]
    if len(units) != 1:
        wanted = "give one light level, ppp = ..., lux = ... or absolute = true"
        raise ValueError(f"{wanted}; {' and '.join(units) or 'none'} given")
    if section.group is not None and section.planes is not None:
        raise ValueError("group sums 2^bits - 1 planes, and planes says how many; give one of them")
    levels: list[dict[str, Any]] = [{}]
    if units[0] != "absolute":
        levels = [{units[0]: level} for level in _several(getattr(section, units[0]), units[0])]
    bits = _several(section.bits, "bits")
    count = len(bits) * len(levels)
    if section.name is not None and count > 1:
        cure = "give one bits and one light level, or leave the name out"
        raise ValueError(f"name: one name for {count} streams; {cure}")
    names = [setting.name for setting in settings_of(Sensing) if setting.recipe and not setting.varied]
    given = {name: getattr(section, name) for name in names if getattr(section, name) is not None}
    for name in ("sensor", "colour"):
        if str(given.get(name)).endswith(".toml"):
            given[name] = str((beside / given[name]).resolve())
    if plugins.file_of(str(given.get("sensor"))):
        given["sensor"] = plugins.beside(str(given["sensor"]), beside)
    return [Sensing(**{"seed": seed} | given, bits=depth, **light) for depth in bits for light in levels]


def _check_streams(sections: list[JobSeries], streams: dict[Sensing, str], path: Path) -> None:
    """`ValueError` with the places of scene and stream for clips whose streams could not be drawn after rendering."""
    seen = set()
    for number, section in enumerate(sections):
        job = section.example
        own = job.family.endswith(".py")  # no other scene may state bands
        case = (job.settings, own)
        if case in seen:
            continue
        seen.add(case)
        for sensing, stream in streams.items():
            with _place(path, f"{stream} of scenes[{number}]"):
                colour = job.settings.bands is not None or (own and filters_of(sensing) is not None)
                clip = _unrendered(sensing.stream_name, job.settings, colour)
                prepare(clip, replace(sensing, ppp=1.0, lux=None))


def _unrendered(name: str, settings: RenderSettings, colour: bool) -> ClipFolder:
    """Return a clip of mean light 1 without frames, for the checks of sensing."""
    info = ClipInfo(
        name=name,
        shape=(settings.frames, *settings.size),
        frame_rate=settings.frame_rate,
        exposure=settings.exposure,
        mean_radiance=1.0,
        bands=RGB if colour else None,
    )
    return ClipFolder(Path(name), info)
