"""The manual describes every public name, option and key, in menus that reach every page. `make docs` builds it."""

from __future__ import annotations

import pkgutil
import re
import subprocess
import sys
import tomllib
from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest

import qsim.cli.program
import quiver.cli.program
from qsim import records
from qsim.cli import documented_keys
from qsim.cli.setting_options import option_names
from qsim.dataset import recipe_file
from qsim.sensor.defects.defect_table import DefectKeys
from qsim.sensor.file_laws import Laws

pytest.importorskip("sphinx")
pytest.importorskip("latex2mathml")
ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
sys.path.append(str(DOCS))

from manual import api, comments_above, generated, mathml, menu, names_in_one_piece, rooms  # noqa: E402


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return api.pages()


def described(pages: dict[str, str]) -> list[str]:
    """The full names that have descriptions."""
    directive = re.compile(r"^\.\. (?:autoclass|autofunction|py:data):: (\S+)$", re.MULTILINE)
    return [name for text in pages.values() for name in directive.findall(text)]


def found(name: str) -> object:
    module, _, own = name.rpartition(".")
    return getattr(import_module(module), own)


# The API reference


def test_every_exported_name_is_described_once(pages):
    names = described(pages)
    assert len(set(names)) == len(names) > 900
    known = {id(found(name)) for name in names}
    rooms = [import_module(name) for name in ("qsim", "quiver")]
    rooms += [
        import_module(module.name)
        for package in list(rooms)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if module.ispkg and ".cli" not in module.name
    ]
    assert len(rooms) > 15
    exported = [(room, name) for room in rooms for name in getattr(room, "__all__", [])]
    assert len(exported) > 120
    assert not [name for room, name in exported if id(getattr(room, name)) not in known]
    for room, name in exported:
        assert f":py:obj:`{name} <" in pages[room.__name__], f"{room.__name__}.{name} is not in its room's table"


def test_names_of_modules_are_found_too(pages):
    names = set(described(pages))
    assert {
        "qsim.scene.Keyframes",
        "qsim.scene.shapes.mesh_file",
        "quiver.data.windows.Batches",
        "qsim.Key",
    } <= names


def test_a_docstring_becomes_restructured_text():
    lines = ["W * bits of `x`:", "", "    code * 2", "", "* one, `Clip`", "  and more", "end_ **bold**"]
    literal = ["::", "", "    code * 2", ""]
    made = [r"W \* bits of ``x``:", "", *literal, "* one, :py:obj:`Clip`", "  and more", "", r"end\_ **bold**"]
    assert api.restructured(lines) == made


def test_fields_carry_the_comments_behind_them():
    fields = documented_keys.fields_of(qsim.QIS)
    assert list(fields) == ["quantum_efficiency", "dark_current", "read_noise", "bits", "gain", "offset", "full_well"]
    assert fields["gain"] == "codes per electron"
    assert documented_keys.fields_of(qsim.Sensing)["ppp"].startswith("mean photons per pixel and code")


# Commands and keys


WORDS = 15  # of a line of help, at most, beside its default


@pytest.mark.parametrize("program", [qsim.cli.program, quiver.cli.program], ids=["qsim", "quiver"])
def test_every_option_of_every_command_is_in_the_reference(program):
    found = program.PROGRAM
    text = (DOCS / f"{found.name}.md").read_text(encoding="utf-8")
    parts = {part.partition("\n")[0]: part for part in text.split("\n## ")}
    assert set(parts) >= {f"{found.name} {name}" for name in found.commands}
    common = (DOCS / "qsim.md").read_text(encoding="utf-8")
    for name in found.commands:
        for setting in found.declared(name).settings:
            assert len(setting.help.split()) <= WORDS, (name, setting.name)
            if not setting.positional:
                for option in option_names(setting):
                    where = parts[f"{found.name} {name}"]
                    assert f"`{option}" in where or f"`{option}`" in common, option


@pytest.mark.parametrize("page", generated.pages(), ids=lambda path: path.stem)
def test_the_generated_parts_of_a_page_are_those_of_the_code(page):
    text = page.read_text(encoding="utf-8")
    assert generated.filled(text) == text, "make reference"
    assert generated.filled(text.replace("| `", "| old `")) == text, "a stale part is noticed"


def test_the_picture_of_the_rooms_is_drawn_from_the_imports():
    """An arrow that follows from others is left out, and none leads upwards."""
    assert rooms.PICTURE.read_text(encoding="utf-8") == rooms.drawing(), "python docs/manual/rooms.py"
    assert rooms.reduced({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == {"a": {"b"}, "b": {"c"}, "c": set()}
    heights = rooms.heights(rooms.imports())
    assert all(heights[room] > heights[one] for room, asked in rooms.imports().items() for one in asked)


RECORDS = dict(recipe_file.SECTIONS) | {"[sensor]": Laws, "[defects]": DefectKeys}


@pytest.mark.parametrize("section", RECORDS)
def test_every_key_has_a_meaning_and_an_example_that_its_check_accepts(section):
    names = [name for name, *_ in documented_keys.flat(RECORDS[section])]
    rows = [row for row in documented_keys.keys(section) if row.name in names]
    assert len(rows) == len(names)
    examples = tomllib.loads("\n".join(f"{row.name} = {row.example}" for row in rows))
    assert records.convert(examples, RECORDS[section], section)
    assert all(row.accepts and len(row.meaning) >= 6 for row in rows)


def test_what_a_check_accepts_is_in_its_words():
    accepts = {row.name: row.accepts for row in documented_keys.keys("[recipe]")}
    assert accepts["shutter"] == "a number from 0 to 1"
    assert accepts["frames"] == "a whole number from 1 to 100000"


# Pages


def listed(page: str = "index") -> list[str]:
    """The pages that the menus reach from a page."""
    below = menu.pages((DOCS / f"{page}.md").read_text(encoding="utf-8"))
    return [page, *(name for one in below for name in (listed(one) if (DOCS / f"{one}.md").is_file() else [one]))]


def test_every_page_is_in_one_menu():
    count = Counter(listed())
    paths = [*DOCS.rglob("*.md"), *(DOCS / "examples").glob("*.py")]
    there = {path.relative_to(DOCS).with_suffix("").as_posix() for path in paths}
    assert set(count) == there
    assert max(count.values()) == 1
    assert len(there) > 25


def test_only_examples_have_pictures_on_their_cards():
    cards = [
        menu.insert((DOCS / f"{page}.md").read_text(encoding="utf-8")) for page in ("examples", "howto", "reference")
    ]
    assert [card.count(":img-top:") > 0 for card in cards] == [True, False, False]


def test_comments_stand_above_the_commands_of_a_page():
    """Not inside a text, and not within a command of several lines."""
    page = "a  # b\n```sh\nqsim x -o y    # makes y\nqsim \\\n  z   # no\n# alone\necho a # b\n```\n"
    wanted = "a  # b\n```sh\n# makes y\nqsim x -o y\nqsim \\\n  z   # no\n# alone\necho a # b\n```\n"
    assert comments_above(page) == wanted


def formulas() -> list[str]:
    texts = [path.read_text(encoding="utf-8") for path in DOCS.rglob("*.md")]
    bare = [re.sub(r"^```.*?^```|`[^`\n]+`", "", text, flags=re.MULTILINE | re.DOTALL) for text in texts]
    return [one or two for text in bare for one, two in re.findall(r"\$\$(.+?)\$\$|\$([^$\n]+)\$", text, re.DOTALL)]


def test_every_formula_becomes_mathml_without_leftovers():
    assert len(formulas()) > 30
    for formula in formulas():
        made = mathml.typeset(formula)
        assert made.startswith("<math")
        assert not re.search(r"[\\$]|negative|mathspace", re.sub(r"<annotation.*", "", made)), formula
    assert "\\" in mathml.typeset(r"\bigl\langle a"), "such a command would be noticed"


def test_pictures_are_small():
    kinds = {".png", ".jpg", ".gif", ".webp", ".svg"}
    sizes = [path.stat().st_size for path in DOCS.rglob("*.*") if path.suffix in kinds]
    assert sum(sizes) <= 9_000_000  # the README's animation takes up to 3 MB, the manual the others


@pytest.mark.slow
def test_the_manual_builds_strictly_and_loads_nothing_from_elsewhere(tmp_path):
    site = tmp_path / "site"
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "-E",
        "-d",
        str(tmp_path / "trees"),
        str(DOCS),
        str(site),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    texts = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    loaded = re.findall(r"<(?:script|img|link)[^>]+(?:src|href)=\"((?:https?:)?//[^\"]+)", "".join(texts.values()))
    assert not loaded, "pages load nothing from elsewhere"
    assert "<math" in texts[site / "physics.html"]
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    assert "Keyframes" in index
    assert "paralyzable" in index
    assert 'id="qsim-sense"' in texts[site / "qsim.html"]
    assert 'id="qsim.sensor.QIS.white"' in texts[site / "api" / "qsim.sensor.html"]


def test_names_in_commands_are_kept_in_one_piece():
    pytest.importorskip("pygments")
    from pygments import highlight
    from pygments.formatters import HtmlFormatter
    from pygments.lexers import BashLexer

    block = highlight("quiver evaluate out/a-b -o out/c --methods moment,qbp-bm3d\n", BashLexer(), HtmlFormatter())
    page = f'<p>--preset</p><div class="highlight-sh notranslate">{block}</div>'
    marked = re.findall(r'<span class="name">(.*?)</span>', names_in_one_piece(page))
    assert marked == ["a-b", "-o", "--methods", "qbp-bm3d"]
    assert re.sub(r"<.*?>", "", names_in_one_piece(page)) == re.sub(r"<.*?>", "", page)


@pytest.mark.parametrize("page", ["qsim.md", "quiver.md"])
def test_options_in_a_sentence_are_code(page):
    """Plain dashes would become a dash: the manual sets --force as an en dash and a word."""
    text = re.sub(r"^```.*?^```|`[^`]*`", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert re.findall(r"(?<![\w<-])--[a-z][\w-]*", text) == []


# Colours


def colours(theme: str) -> dict[str, str]:
    """The colours of a theme in the built manual: those of the package, then those of the project."""
    import pydata_sphinx_theme

    package = Path(pydata_sphinx_theme.__file__).parent / "theme/pydata_sphinx_theme/static/styles"
    values: dict[str, str] = {}
    for sheet in (package / "pydata-sphinx-theme.css", DOCS / "static" / "manual.css"):
        rules = re.findall(r"([^{}]*)\{([^{}]*)\}", sheet.read_text(encoding="utf-8"))
        for selector, body in rules:
            if re.fullmatch(rf"\s*(?:/\*.*?\*/\s*)?(?:html|html\[data-theme=\"?{theme}\"?\])\s*", selector, re.DOTALL):
                values |= dict(re.findall(r"--pst-([\w-]+):\s*([^;}]+)", body))
    return values


def luminance(colour: str) -> float:
    digits = colour.strip().removeprefix("#")
    digits = digits if len(digits) == 6 else "".join(2 * digit for digit in digits)
    shares = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    red, green, blue = (x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in shares)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one: str, other: str) -> float:
    """The ratio of WCAG 2: 4.5 is asked of text."""
    dark, bright = sorted((luminance(one), luminance(other)))
    return (bright + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("text", ["text-base", "text-muted", "heading", "inline-code", "link", "link-hover"])
def test_text_has_contrast_on_each_ground_of_both_themes(theme, text):
    pytest.importorskip("pydata_sphinx_theme")
    values = colours(theme)

    def colour(name: str) -> str:
        value = values[f"color-{name}"].strip()
        inner = re.fullmatch(r"var\(--pst-color-([\w-]+)\)", value)
        return colour(inner[1]) if inner else value

    for ground in ("background", "surface", "on-background"):
        assert contrast(colour(text), colour(ground)) >= 4.5, ground
