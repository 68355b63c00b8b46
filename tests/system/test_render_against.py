"""The benchmark of two checkouts names clips of the recipe, and compares files by their checksums."""

from __future__ import annotations

import sys
from pathlib import Path

from qsim.dataset import recipe

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import render_against  # noqa: E402  (programs are not a package)


def test_its_clips_are_those_of_the_recipe():
    jobs = {job.name: job for job in recipe.load(ROOT / "scenes" / "i2_2000fps.toml").jobs}
    for case in render_against.CASES:
        job = jobs[case.name]
        assert (job.family, job.scene_seed, job.speed) == (case.family, case.seed, case.speed)


def test_a_file_that_differs_or_is_missing_does_not_count():
    before = [{"radiance": "a", "flow": "b"}, {"radiance": "c"}]
    after = [{"radiance": "a", "flow": "x"}, {}]
    assert render_against.equal_files(before, before) == "3 of 3"
    assert render_against.equal_files(before, after) == "1 of 3"
