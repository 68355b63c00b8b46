"""The recipe `photons` from its clips to time stamps, clocked codes, restored video and a report."""

from __future__ import annotations

import fakes
import numpy as np

from qsim.cli.program import main
from qsim.dataset import generation, recipe
from qsim.formats import photon_times
from qsim.streams.stream import Stream
from quiver.cli.program import main as quiver


def test_from_the_recipe_to_clocked_codes(tmp_path, capsys):
    """Clips of a quick renderer of tests: counts equal codes, a dead time of 35 ns holds, both streams are restored."""
    text = recipe.text_of("photons")[1].replace("height = 64", "height = 7").replace("width = 64", "width = 9")
    parsed = recipe.parse(text)
    assert all(stream.follow for job in parsed.jobs for stream in job.streams)
    generation.generate(parsed, tmp_path / "data", fakes.HERE, make=fakes.make)
    assert main(["check", str(tmp_path / "data"), "--redraw"]) == 0
    assert "all hold the reference's codes" in capsys.readouterr().out
    stream = Stream.open(tmp_path / "data" / "clips" / "text_0000" / "streams" / "photons.json")
    assert main(["convert", str(stream.path.with_suffix(".json")), str(tmp_path / "p.npz")]) == 0
    found = photon_times.read(tmp_path / "p.npz")
    np.testing.assert_array_equal(found.counts(), stream.codes())
    assert min(found.intervals(y, x).min(initial=1.0) for y, x in np.ndindex(7, 9)) >= 35e-9 * (1 - 1e-9)
    words = ["convert", str(tmp_path / "p.npz"), str(tmp_path / "clocked"), "--bits", "3", "--frame-rate", "2000"]
    assert main(words) == 0
    for source in (stream.path, tmp_path / "clocked.npy"):
        out = tmp_path / f"restored_{source.stem}.npy"
        assert quiver(["restore", str(source), "-o", str(out), "--method", "moment"]) == 0
        assert np.load(out).shape == (8, 7, 9)
    assert main(["report", str(tmp_path / "data" / "clips" / "text_0000"), "-o", str(tmp_path / "r.html")]) == 0
