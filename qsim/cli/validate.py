"""Runs `qsim validate`: speed against error of sensors, renderer, engines and reading."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from qsim.cli.command import Idle, command
from qsim.cli.completion import families
from qsim.cli.console import bar, note, output, refuse_existing
from qsim.figures import check_figure
from qsim.kinds import Frames, Psnr, Seed, Whole
from qsim.settings import setting

# defaults
PIXELS = 1 << 22
HEIGHT = 128
WIDTH = 256
PSNR = 36.0

# Options that act, beside --seed and those of every command.
ACTING = {
    "sensor": ("output", "force", "pixels", "require_speed"),
    "render": ("output", "force", "scenes", "height", "width"),
    "light": ("scenes", "height", "width", "psnr"),
    "engines": ("scenes", "height", "width"),
    "reading": (),
}


@dataclass(frozen=True)
class Validate:
    """What `qsim validate` measures."""

    what: Annotated[
        Literal["sensor", "render", "light", "engines", "reading"], setting("what to validate", positional=True)
    ]
    output: Annotated[Path | None, setting("sensor, render: figure (.png, .svg or .pdf)", short="o")] = None
    pixels: Annotated[Whole | None, setting("sensor: pixels per draw", unset=f"{PIXELS}")] = None
    seed: Annotated[Seed, setting("seed of the draws")] = 0
    require_speed: Annotated[bool, setting("sensor: fail if a speed is below its target")] = False
    scenes: Annotated[
        tuple[str, ...] | None,
        setting(
            "render, engines, light: families or own scenes",
            unset="four; light: all that were not used for tuning",
            shown="FAMILY",
            several="following",
            known=families,
        ),
    ] = None
    height: Annotated[Frames | None, setting("render, engines, light: pixels", unset=f"{HEIGHT}")] = None
    width: Annotated[Frames | None, setting("render, engines, light: pixels", unset=f"{WIDTH}")] = None
    psnr: Annotated[Psnr | None, setting("light: required error, dB below white", unset=f"{PSNR:g}")] = None
    force: Annotated[bool, setting("replace an existing figure")] = False

    @property
    def size(self) -> tuple[int, int]:
        """Return rows and columns of rendered scenes [px]."""
        return self.height or HEIGHT, self.width or WIDTH


def _idle() -> list[Idle]:
    """Return what cannot act: for each measurement the options of the others, and --force without a figure."""
    every = sorted({name for names in ACTING.values() for name in names})
    table = []
    for what, acting in ACTING.items():
        idle = tuple(name for name in every if name not in acting)

        def case(asked: Validate, what: str = what) -> str:
            return f"changes nothing in `validate {what}`" if asked.what == what else ""

        table.append(Idle(case, idle))
    return [*table, Idle(lambda asked: "" if asked.output else "replaces the figure of --output", ("force",))]


@command(
    "qsim validate sensor --json -o out/sensor.png",
    "qsim validate render -o out/render.png",
    "qsim validate light --scenes glossy room --height 64 --width 96",
    "qsim validate engines --scenes fan glass",
    "qsim validate reading",
    threads="threads of the compiled engine (Dr.Jit)",
    idle=_idle(),
)
def validate(asked: Validate) -> int:
    """Measure, print the report, and return 1 if a bound is missed."""
    if asked.output is not None:
        check_figure(asked.output)
        refuse_existing(asked.output, asked.force)
    run = {"sensor": _sensor, "render": _render, "light": _light, "engines": _engines, "reading": _reading}
    return run[asked.what](asked)


def _sensor(asked: Validate) -> int:
    from qsim.studies.validation import sensors

    pixels = PIXELS if asked.pixels is None else asked.pixels
    with bar("measuring", "model") as progress:
        report = sensors.run(pixels, asked.seed, require_speed=asked.require_speed, progress=progress)
    if asked.output is not None:
        sensors.figure(report, asked.output)
    output(report.to_dict(), sensors.table(report))
    return 0 if report.ok else 1


def _reading(asked: Validate) -> int:
    from qsim.studies.validation import reading

    report = reading.run(seed=asked.seed)
    output(report.to_dict(), report.lines())
    return 0 if report.ok else 1


def _engines(asked: Validate) -> int:
    from qsim.studies.validation import backends

    names = _families(asked)[:4] if asked.scenes is None else list(asked.scenes)
    height, width = asked.size
    report = backends.run(names, height=height, width=width, seed=asked.seed + 3, progress=note)
    output(report.to_dict(), backends.table(report))
    return 0 if report.ok else 1


def _families(asked: Validate) -> list[str]:
    """The given scenes, or those that were not used to tune the budget."""
    from qsim import scenes
    from qsim.studies.validation import rendering

    return list(asked.scenes or ()) or [name for name in scenes.FAMILIES if name not in rendering.TUNED]


def _scenes(asked: Validate, names: list[str]) -> list[Any]:
    from qsim import scenes

    return [scenes.load(name, seed=asked.seed + 3).resized(*asked.size) for name in names]


def _render(asked: Validate) -> int:
    from qsim.studies.validation import rendering

    names = _families(asked)[:4] if asked.scenes is None else list(asked.scenes)
    report = rendering.run(_scenes(asked, names), progress=note)
    if asked.output is not None:
        rendering.figure(report, asked.output)
    output(report.to_dict(), rendering.table(report))
    return 0 if report.ok else 1


def _light(asked: Validate) -> int:
    from qsim.studies.validation import light

    levels = (PSNR if asked.psnr is None else asked.psnr,)
    report = light.run(_scenes(asked, _families(asked)), levels=levels, seed=asked.seed, progress=note)
    output(report.to_dict(), light.table(report))
    return 0 if report.ok else 1
