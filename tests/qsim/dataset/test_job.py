"""Digests of jobs: settings that are off, and the files that streams read."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qsim.dataset import recipe
from qsim.dataset.job import Job
from qsim.rendering.render_settings import RenderSettings
from qsim.streams.sensing import Sensing

FILTERS = '[colour]\nmask = "rggb"\nefficiency.R = 0.4\nefficiency.G = 0.6\nefficiency.B = 0.5\n'
MAPPED = """[sensor]
model = "BinarySPAD"
pde = 0.5
dark_count_rate = 9.0
bits = 1
[defects]
dark_map = "rates.npy"
"""
STREAMS = {
    "filters": '[[streams]]\nsensor = "quiver-physical"\nppp = 3.0\ncolour = "filters.toml"\n',
    "map": '[[streams]]\nsensor = "mapped.toml"\nppp = 3.0\n',
}


def job_in(folder: Path, kind: str, light: float) -> Job:
    """Return the job of a recipe in `folder` beside filters and a map, which state `light`."""
    folder.mkdir(exist_ok=True)
    (folder / "filters.toml").write_text(FILTERS.replace("0.4", str(light)))
    (folder / "mapped.toml").write_text(MAPPED)
    np.save(folder / "rates.npy", np.full((8, 10), light))
    bands = 'bands = "rgb"\n' if kind == "filters" else ""
    head = f'[recipe]\nname = "r"\nframes = 2\nheight = 8\nwidth = 10\n{bands}[[scenes]]\nfamily = "fan"\n'
    (job,) = recipe.parse(head + STREAMS[kind], folder / "recipe.toml").jobs
    return job


@pytest.mark.parametrize("kind", STREAMS)
def test_filters_and_measured_maps_decide_the_digest_and_their_folder_does_not(tmp_path: Path, kind: str):
    """Edited filters or a new map gave the old digest, and moving the filters with their recipe gave another."""
    before = job_in(tmp_path / "a", kind, 0.4).digest
    assert job_in(tmp_path / "b", kind, 0.4).digest == before
    edited = job_in(tmp_path / "a", kind, 0.3)
    assert edited.digest != before
    assert edited.digest == job_in(tmp_path / "b", kind, 0.3).digest


def test_a_setting_that_is_off_changes_no_digest():
    """Not even one that does not exist yet: a record with one more field of any default has the same digest."""
    settings = RenderSettings(frames=3, height=8, width=9, frame_rate=2000.0)
    stream = Sensing("quiver-physical", bits=3, ppp=3.25)
    job = Job("fan", 1, 1.0, "train", settings, 7, (stream,))
    for record, name in ((settings, "settings"), (stream, "streams")):
        kind = type(record)
        for added in (None, False, 1, 0.0):
            wider = dataclasses.make_dataclass("Wider", [("later", object, added)], bases=(kind,), frozen=True)
            values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
            other = wider(**values)
            assert replace(job, **{name: (other,) if name == "streams" else other}).digest == job.digest
    for changed in (replace(settings, psnr=41.0), replace(settings, bands="rgb"), replace(settings, reuse=False)):
        assert replace(job, settings=changed).digest != job.digest
    for changed in (replace(stream, bits=2), replace(stream, slices=2), replace(stream, follow=True)):
        assert replace(job, streams=(changed,)).digest != job.digest
