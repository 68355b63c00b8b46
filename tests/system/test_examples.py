"""The examples of the manual run at small sizes; their stored results belong to their code."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("latex2mathml")
pytest.importorskip("torch")
ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs"))

from manual import examples  # noqa: E402

EXAMPLES = sorted(examples.FOLDER.glob("*.py"))
SLOW = (  # 4 to 25 s of processor time; the others up to 3 s
    "bit_depth",
    "bracketing",
    "challenge",
    "colour",
    "on_a_cluster",
    "pytorch",
    "readouts",
    "restoring",
    "spad_camera",
    "training",
)


def test_there_are_examples():
    assert len(EXAMPLES) >= 12


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=pytest.mark.slow if p.stem in SLOW else ()) for p in EXAMPLES], ids=lambda p: p.stem
)
def test_an_example_runs_at_small_sizes(path, tmp_path, monkeypatch):
    import matplotlib
    import matplotlib.pyplot as plt

    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    text = path.read_text(encoding="utf-8")
    made = examples.small(text)
    assert made != text, "an example has sizes for the tests"
    try:
        exec(compile(made, str(path), "exec", dont_inherit=True), {"__name__": path.stem})
        assert plt.get_fignums(), "an example draws"
    finally:
        plt.close("all")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_stored_results_are_those_of_the_code(path):
    text = path.read_text(encoding="utf-8")
    assert examples.stored(path.stem)["code"] == examples.digest(text), "run `python docs/run_examples.py`"
    assert len(examples.outputs(path.stem)) == len(examples.cells(text))


def test_every_picture_belongs_to_an_example():
    named = {name for path in EXAMPLES for cell in examples.outputs(path.stem) for name in cell.pictures}
    there = {path.name for path in examples.RESULTS.iterdir() if path.suffix != ".json"}
    assert named == there
    assert len(there) >= len(EXAMPLES)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_pages_and_notebooks_hold_the_cells_and_the_results(path):
    page = examples.page(path.stem)
    book = examples.notebook(path.stem)
    assert page.startswith("# ")
    assert f"{path.stem}.ipynb" in page
    assert "# tests:" not in page
    code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    for cell in code:
        compile(cell["source"], path.name, "exec")
        assert cell["source"] in page
    results = examples.outputs(path.stem)
    drawn = [one for cell in code for one in cell["outputs"] if one["output_type"] == "display_data"]
    assert len(drawn) == sum(len(result.pictures) for result in results) == page.count("(results/") > 0
    assert len({cell["id"] for cell in book["cells"]}) == len(book["cells"])
    assert book["nbformat"] == 4


def test_cells_are_text_and_code():
    source = '"""\n# Title\n\nIntro.\n"""\n\n# %%\n# First `x`.\n\nx = 3  # tests: 1\n# a comment\n\n# %%\ny = x\n'
    found = examples.cells(source)
    assert found == [("# Title\n\nIntro.", ""), ("First `x`.", "x = 3  # tests: 1\n# a comment"), ("", "y = x")]
    assert "x = 1\n" in examples.small(source)
    assert examples.shown(found[1].code) == "x = 3\n# a comment"
    assert examples.digest(source) == examples.digest(source.replace("First", "Second"))
    assert examples.digest(source) != examples.digest(source.replace("= 3", "= 4"))
