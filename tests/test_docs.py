"""What the documents show is what the programs do: every Python block runs, every command line is understood."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

import qsim.cli
import quiver.cli
import quiver.data

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "scenes" / "README.md"]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(language: str) -> list[tuple[str, str]]:
    return [
        (path.name, body)
        for path in DOCUMENTS
        if path.exists()
        for kind, body in BLOCK.findall(path.read_text(encoding="utf-8"))
        if kind == language
    ]


def commands() -> list[list[str]]:
    """The qsim and quiver command lines of all shell blocks, continued lines joined, comments taken off."""
    found = []
    for _, body in blocks("sh"):
        for line in body.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words and words[0] in ("qsim", "quiver"):
                found.append(words)
    return found


def test_there_is_something_to_check():
    assert len(blocks("python")) >= 1
    assert len(commands()) >= 5


@pytest.mark.parametrize(("name", "body"), blocks("python"), ids=lambda value: value if value.endswith(".md") else "")
def test_python_blocks_run(name, body, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(body, name, "exec"), {"__name__": name})


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_commands_are_understood(words, monkeypatch):
    program, home = {"qsim": (qsim.cli, qsim.cli), "quiver": (quiver.cli, quiver.data)}[words[0]]
    monkeypatch.setattr(home, "run", lambda parser, argv: parser.parse_args(argv))
    assert program.main(words[1:]) is not None


def test_a_wrong_command_would_be_noticed(monkeypatch):
    monkeypatch.setattr(qsim.cli, "run", lambda parser, argv: parser.parse_args(argv))
    with pytest.raises(SystemExit):
        qsim.cli.main(["sense", "clip", "--pppp", "3"])


def test_relative_links_lead_somewhere():
    for path in DOCUMENTS:
        if not path.exists():
            continue
        for target in re.findall(r"\]\(([^)#\s]+)", path.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (path.parent / target).exists(), f"{path.name}: {target}"


def test_readme_tree_has_a_line_for_every_file():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for folder in ("qsim", "quiver", "quiver/baselines"):
        for path in (ROOT / folder).glob("*.py"):
            if not path.name.startswith("__"):
                assert re.search(rf"^\s+{re.escape(path.name)}\s+\S", text, re.MULTILINE), f"{folder}/{path.name}"
