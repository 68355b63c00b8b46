"""What the documents show is what the programs do.

Quick: every Python block runs, page by page in one folder; every qsim and quiver command line is understood. Slow:
every page runs from top to bottom as a reader would type it, with recipes made small. A comment above a block says
otherwise:

    <!-- not run: WHY -->           understood, not run
    <!-- run with: OLD => NEW -->   run with these words instead (several: with " | " between them)
    <!-- file: NAME -->             the block is a file of that name
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from spad_files import write_recordings

import qsim.cli.program
import quiver.cli.program
from qsim.cli.usage import UsageError
from qsim.studies.validation.reading import ReadingReport

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "scenes" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
BLOCK = re.compile(r"(?:^<!-- (not run|run with|file): (.*?) -->\n)?^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block and the comment above it."""

    language: str
    body: str
    directive: str = ""  # not run, run with, file
    words: str = ""

    @property
    def as_run(self) -> str:
        """The body with the words that a test uses instead."""
        text = self.body
        for change in self.words.split(" | ") if self.directive == "run with" else []:
            old, _, new = change.partition(" => ")
            assert old in text, f"{old!r} is not in the block below its comment"
            text = text.replace(old, new)
        return text


def blocks(path: Path) -> list[Block]:
    found = BLOCK.findall(path.read_text(encoding="utf-8"))
    return [Block(language, body, directive, words) for directive, words, language, body in found]


def place(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def commands(*pages: Path) -> list[list[str]]:
    """The qsim and quiver command lines of all shell blocks, continued lines joined, comments and redirections off."""
    found = []
    for path in pages or DOCUMENTS:
        for block in blocks(path):
            if block.language != "sh":
                continue
            for line in block.body.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                words = words[: words.index(">")] if ">" in words else words
                if words and words[0] in ("qsim", "quiver") and words not in found:
                    found.append(words)
    return found


def test_there_is_something_to_check():
    assert sum(block.language == "python" for path in DOCUMENTS for block in blocks(path)) >= 8
    assert len(commands()) >= 40


@pytest.mark.parametrize("path", DOCUMENTS, ids=place)
def test_every_command_is_in_a_block_and_every_exception_says_why(path):
    text = path.read_text(encoding="utf-8")
    outside = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    assert not re.findall(r"^    (?:qsim|quiver|python|make) .*", outside, re.MULTILINE)
    assert not re.findall(r"^(?:```+|:::+) *\{", text, re.MULTILINE), "code in a directive would not be run"
    for block in blocks(path):
        assert block.language in ("python", "sh", "toml", "text")
        if block.directive == "not run":
            assert len(block.words.split()) >= 3, "say why"
        assert block.as_run


def python_pages() -> list[Path]:
    return [path for path in DOCUMENTS if any(block.language == "python" for block in blocks(path))]


@pytest.mark.parametrize("path", python_pages(), ids=place)
def test_python_blocks_run(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks(path):
        if block.language == "python" and block.directive != "not run":
            exec(compile(block.as_run, path.name, "exec", dont_inherit=True), {"__name__": path.name})


def test_the_clip_of_one_stream_holds_the_windows_of_its_network():
    """The page prints no size of them, and its test changes the length of the training only."""
    from quiver.training.system import protocol
    from quiver.training.systems import system_named

    (block,) = [found for found in blocks(ROOT / "docs" / "training.md") if "--preset bit2bit" in found.body]
    frames, height, width = map(int, re.findall(r"--(?:frames|height|width) (\d+)", block.body))
    quick = protocol(system_named("bit2bit"), "quick")
    assert frames >= quick["frames"]
    assert min(height, width) >= quick["crop"]
    assert block.words == "--minutes 20 => --steps 1"


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_commands_are_understood(words):
    program = {"qsim": qsim.cli.program, "quiver": quiver.cli.program}[words[0]].PROGRAM
    command, _ = program.read(words[1:])
    assert command is program.declared(words[1])


def test_a_wrong_command_would_be_noticed():
    with pytest.raises(UsageError, match="unknown option --pppp"):
        qsim.cli.program.PROGRAM.read(["sense", "clip", "--pppp", "3"])


def test_a_page_that_fails_would_be_noticed(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```sh\nqsim check none   # no such clip\n```\n")
    with pytest.raises(AssertionError, match="no such clip"):
        follow(page, tmp_path)


# Pages as a reader types them


def _calibration(folder: Path) -> None:
    """Dark and flat frames of the cameras on the page, as files."""
    rng = np.random.default_rng(0)

    def few_electrons(light: float, exposure: float) -> np.ndarray:
        electrons = rng.poisson(light + 20 * exposure, (20, 40, 40)) + 0.25 * rng.standard_normal((20, 40, 40))
        return np.clip(np.rint(8 * electrons + 40), 0, 255).astype(np.uint8)

    for name, light, exposure in (
        ("dark_1ms", 0, 1e-3),
        ("dark_50ms", 0, 5e-2),
        ("flat_a", 0.5, 1e-3),
        ("flat_b", 2, 1e-3),
        ("flat_c", 6, 1e-3),
    ):
        np.save(folder / f"{name}.npy", few_electrons(light, exposure))
    counts = {"dark": 0.01, "flat": 0.3, "dim": 1.6, "bright": 16}
    for name, mean in counts.items():
        np.save(
            folder / f"{name}.npy",
            np.minimum(rng.poisson(mean, (200, 24, 24)), 1 if mean < 1 else 255).astype(np.uint8),
        )
    for name, share in (("dark_sums", 0.01), ("flat_sums", 0.3)):
        np.save(folder / f"{name}.npy", rng.binomial(50, share, (4, 24, 24)).astype(np.uint16))
    subprocess.run(
        [
            sys.executable,
            "-m",
            "qsim",
            "render",
            "fan",
            "-o",
            "out/fan",
            "--frames",
            "3",
            "--height",
            "32",
            "--width",
            "32",
            "-q",
        ],
        cwd=folder,
        check=True,
        env=_environment(),
    )


def _spad_camera(folder: Path) -> None:
    """Raw planes of a small camera, and the recipe `spad` with one small clip, which is as long."""
    write_recordings(folder)
    text = (ROOT / "scenes" / "spad.toml").read_text()
    head, fan, *_, streams = re.split(r"(?=\[\[)", text)
    text = f"{head}{fan}{streams}"
    for key, value in {"height": 32, "width": 32, "psnr": 15.0}.items():
        text = re.sub(rf"^{key} = .*", f"{key} = {value}", text, flags=re.MULTILINE)
    (folder / "small.toml").write_text(text)


BEFORE: dict[str, Callable[[Path], None]] = {
    "docs/calibrate.md": _calibration,
    "docs/spad_camera.md": _spad_camera,
}


def _environment() -> dict[str, str]:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def follow(path: Path, folder: Path) -> None:
    """Run all blocks of a page in order in a folder, which has the recipes in it, made small."""
    (folder / "scenes").mkdir()
    for recipe in (ROOT / "scenes").glob("*.toml"):
        text = recipe.read_text()
        for key, value in {"frames": 12, "height": 32, "width": 32, "psnr": 20.0}.items():
            text = re.sub(rf"^{key} = .*", f"{key} = {value}", text, flags=re.MULTILINE)
        (folder / "scenes" / recipe.name).write_text(text)
    for block in blocks(path):
        if block.directive == "not run" or block.language == "text":
            continue
        if block.directive == "file":
            (folder / block.words).write_text(block.body)
            continue
        run = ["bash", "-e", "-c", block.as_run] if block.language == "sh" else [sys.executable, "-c", block.as_run]
        done = subprocess.run(run, cwd=folder, env=_environment(), capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{path.name}:\n{block.as_run}\n{done.stdout[-500:]}\n{done.stderr[-1500:]}"


def pages_with_commands() -> list[Path]:
    return [p for p in DOCUMENTS if any(b.language == "sh" and b.directive != "not run" for b in blocks(p))]


@pytest.mark.slow
@pytest.mark.parametrize("path", pages_with_commands(), ids=place)
def test_a_page_runs_from_top_to_bottom(path, tmp_path):
    BEFORE.get(place(path), lambda folder: None)(tmp_path)
    follow(path, tmp_path)


IN_PLACE = {"mergenet": "moment", "out/mine": "moment", "moment,mergenet,out/mine": "naive,moment"}
LEFT_OUT = ("generate", "train")


def test_a_camera_is_read_measured_and_restored(tmp_path, monkeypatch, capsys):
    """From raw bytes to video with time stamps: hot pixels are found by the darks and filled, rates are printed."""
    monkeypatch.chdir(tmp_path)
    hot = write_recordings(tmp_path)
    mains = {"qsim": qsim.cli.program.main, "quiver": quiver.cli.program.main}
    ran = []
    for program, command, *words in commands(ROOT / "docs" / "spad_camera.md"):
        if command in LEFT_OUT:
            continue
        words = [IN_PLACE.get(word, word) for word in words]
        assert mains[program]([command, *words]) == 0, shlex.join([program, command, *words])
        ran.append(command)
    assert set(ran) == {"convert", "preview", "calibrate", "restore", "evaluate"}
    np.testing.assert_array_equal(np.load("out/spad_hot.npy"), hot)
    said = capsys.readouterr()
    assert "7 planes per code, 10000 planes/s, 1428.57 codes/s" in said.out
    assert f"{hot.sum()} of {hot.size} pixels defective and filled" in said.err
    found = json.loads(Path("out/video.json").read_text())
    assert found["shape"] == [40, *hot.shape]
    np.testing.assert_allclose(found["times"]["values"], (70 + 3.5 + 7 * np.arange(40)) * 1e-4)


@pytest.mark.parametrize("path", sorted((ROOT / "scenes").glob("*.toml")), ids=place)
def test_every_recipe_of_the_library_is_read(path):
    """Those that no page runs because they are too large included."""
    from qsim.dataset import recipe

    assert recipe.load(path).jobs


# Links and trees


def test_relative_links_lead_somewhere():
    for path in DOCUMENTS:
        for target in re.findall(r"\]\(([^)#\s]+)", path.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (path.parent / target).exists(), f"{path.name}: {target}"


def _load(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_readme_and_changelog_are_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= 40


WRITTEN = ("million.md", "log.md")  # by programs, and the laboratory book


PROSE = [path for path in sorted((ROOT / "docs").glob("*.md")) if path.name not in WRITTEN]
PROSE += [ROOT / "README.md", ROOT / "scenes" / "README.md"]
NO_PROSE = (r"^ *```.*?^ *```", r"^<!-- generated.*?^<!-- end -->", r"^ *\$\$.*?\$\$", r"^(\||!\[|<!--|    |#).*?$")


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_prose_can_be_read(page: Path):
    """Lines of at most 110 characters, sentences of at most 25 words; a formula and code count as a word."""
    text = page.read_text(encoding="utf-8")
    for left_out in NO_PROSE:
        text = re.sub(left_out, "\n", text, flags=re.MULTILINE | re.DOTALL)
    assert [line for line in text.splitlines() if len(line) > 110] == []
    for shown, plain in ((r"\[([^\]]*)\]\([^)]*\)", r"\1"), (r"\$[^$]*\$", "X"), (r"`[^`]*`", "X")):
        text = re.sub(shown, plain, text)
    paragraphs = re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", text)
    sentences = [each for one in paragraphs for each in re.split(r"(?<=[.!?:;])\s+", one)]
    assert [each for each in sentences if len(each.split()) > 25] == []


OUR_WORDS = r"\b(plane|code|white|matched|cell|clip|stream)s?\b"
LOOKED_UP = {"README.md", "api.md", "architecture.md", "errors.md", "examples.md", "glossary.md", "gpu.md", "howto.md"}
LOOKED_UP |= {
    "index.md",
    "limits.md",
    "promises.md",
    "qsim.md",
    "quiver.md",
    "recipes.md",
    "reference.md",
    "results.md",
}
LOOKED_UP |= {
    "defects.md",
    "release.md",
    "tutorials.md",
    "explanation.md",
    "million.md",
    "log.md",
}  # menus, references, developers' pages
READ = [path for path in sorted((ROOT / "docs").glob("*.md")) if path.name not in LOOKED_UP]


@pytest.mark.parametrize("page", READ, ids=lambda page: page.name)
def test_a_page_that_uses_our_words_links_the_glossary(page: Path):
    text = page.read_text(encoding="utf-8")
    words = re.sub(r"^```.*?^```|`[^`]*`", "", text, flags=re.MULTILINE | re.DOTALL)
    if re.search(OUR_WORDS, words):
        assert "](glossary.md" in text


RETIRED = r"\b(?:(?:is|are) (?:told|refused)|without a word|of before|as of now)\b"


@pytest.mark.parametrize("page", PROSE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_prose_has_no_retired_words(page: Path):
    text = page.read_text(encoding="utf-8")
    for left_out in NO_PROSE:
        text = re.sub(left_out, "\n", text, flags=re.MULTILINE | re.DOTALL)
    assert re.findall(RETIRED, " ".join(text.split())) == []


def test_files_named_on_the_page_of_the_architecture_exist():
    """Full paths, and names after one of them."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    there = {path.name for name in ("qsim", "quiver", "tests", "docs") for path in (ROOT / name).rglob("*.py")}
    assert set(re.findall(r"\b([a-z_]+\.py)", page)) <= {*there, "mine.py"}
    assert not [
        path
        for path in re.findall(r"\b(?:qsim|quiver|tests)/[a-z_/.]*[a-z]\b(?!/?[A-Z])", page)
        if not (ROOT / path).exists()
    ]


def test_the_page_of_evidence_is_made_from_its_numbers():
    numbers = json.loads((ROOT / "docs" / "evidence.json").read_text())
    page = (ROOT / "docs" / "evidence.md").read_text(encoding="utf-8")
    assert page == _load("evidence").page(numbers), "run `python benchmarks/evidence.py --page-only`"
    numbers["sensor"]["report"]["ok"] = False
    assert "outside its bounds" in _load("evidence").page(numbers)
    numbers["reading"]["report"] = ReadingReport(250.0, 20.0, 300.0, 9.0, 0.3).to_dict()
    page = _load("evidence").page(numbers)
    assert "| clip folder | 250.0 | 300.0 |" in page
    assert "(100 windows/s, 5 times the mp4) is **not reached** in this run" in page
    assert "These rows were stored before the chosen numbers of samples were" in page
    for row in numbers["render"]["report"]["rows"]:
        row["chosen_samples"] = row["samples"]
    numbers["render"]["report"]["rows"][0]["chosen_samples"] = 8
    page = _load("evidence").page(numbers)
    assert "These rows were stored before" not in page
    assert page.count(", raised from ") == page.count("| 12, raised from 8 |") == 1


def test_tests_named_as_evidence_exist():
    page = (ROOT / "docs" / "evidence.md").read_text(encoding="utf-8")
    names = re.findall(r"`(?:tests/\w+/|tests/)?(test_\w+\.py)`", page)
    there = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    assert len(names) >= 10
    assert set(names) <= there


def test_pages_that_are_read_one_after_another_do_not_share_results():
    """The second page ended with `out/fan: exists`. Commands that resume may share a place."""
    pages = (ROOT / "README.md", ROOT / "docs" / "start.md", ROOT / "docs" / "training.md")
    resumed = {"out/data", "out/mine"}
    found = [{target for words in commands(page) for target in targets(words)} - resumed for page in pages]
    for i, one in enumerate(found):
        for other in found[i + 1 :]:
            assert not one & other


def targets(words: list[str]) -> set[str]:
    """Return what follows -o in a command."""
    return {name for option, name in itertools.pairwise(words) if option in ("-o", "--output")}
