"""Cells of a domain are measured once, stored with the weights, and kept."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from domains import cell, run, tensors_digest, weights
from golden import SMALL
from sensor_files import QIS, sensor_file

from quiver.data.clips import open_clips
from quiver.data.illumination import Illumination
from quiver.evaluation import domain_measurement
from quiver.evaluation.domain_measurement import DomainSettings
from quiver.model.quiver import QUIVER
from quiver.model.weights import annotate, metadata_of, save
from quiver.restoration import domain
from quiver.restoration.domain import Cell, Domain
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.networks import network_restorer
from quiver.restoration.restorers import restorer


def test_cells_are_measured_stored_and_kept(tiny_dataset, tmp_path, monkeypatch):
    path = weights(tmp_path)
    before = tensors_digest(path)
    clips = domain_measurement.clips_of([tiny_dataset], "test")
    lights = (Illumination.of(ppp=3.25), Illumination.of("spad-320x240", 1.0, 1))
    settings = domain_measurement.DomainSettings(clips, lights, ("naive", "moment:3"))
    asked: list[Illumination] = []
    measured = domain_measurement.measure_cell

    def noted(network, methods, settings, light, rival):
        asked.append(light)
        return measured(network, methods, settings, light, rival)

    monkeypatch.setattr(domain_measurement, "measure_cell", noted)
    found = domain_measurement.measure(path, settings, RestoreOptions(device="cpu"))
    assert asked == list(lights)
    assert tensors_digest(path) == before
    assert found == domain.read_scope(path, metadata_of(path)).domain
    assert found.measured["clips"] == [clip.name for clip in clips]
    best = max(
        np.mean([domain_measurement.score(restorer(m), c, lights[0], 0) for c in clips]) for m in settings.methods
    )
    own = next(c for c in found.cells if c.place.model == "QIS")
    assert own.classical_psnr == pytest.approx(best, abs=6e-4)
    assert not own.wins  # random weights
    assert found.measured[domain_measurement.METHODS_ARE] == [restorer(name).description for name in settings.methods]

    assert (
        domain_measurement.measure(path, settings, RestoreOptions(device="cpu")) == found
    )  # nothing is left to measure
    assert len(asked) == 2
    domain_measurement.measure(path, replace(settings, lights=lights[:1]), RestoreOptions(device="cpu"), force=True)
    assert len(asked) == 3
    other_seed = replace(settings, seed=1, lights=lights[:1])
    with pytest.raises(ValueError, match=r"measured otherwise \(not the same: seed"):
        domain_measurement.measure(path, other_seed, RestoreOptions(device="cpu"))
    other = domain_measurement.measure(path, other_seed, RestoreOptions(device="cpu"), force=True)
    assert len(other.cells) == 1  # cells of another noise do not stand beside these
    assert not list(tmp_path.glob("*.lock"))
    with pytest.raises(ValueError, match="measured against classical methods, got mergenet"):
        domain_measurement.measure(path, replace(settings, methods=("mergenet",)), RestoreOptions(device="cpu"))
    with pytest.raises(ValueError, match="unknown split 'none'"):
        domain_measurement.clips_of([tiny_dataset], "none")


def test_classical_scores_are_taken_from_other_weights_on_the_same_clips(tiny_dataset, tmp_path, monkeypatch):
    """The network alone is restored, and its cells are those of a complete measurement."""
    old = weights(tmp_path)
    new = Path(shutil.copyfile(old, tmp_path / "new.safetensors"))
    clips = domain_measurement.clips_of([tiny_dataset], "test")
    lights = (Illumination.of(ppp=3.25), Illumination.of("spad-320x240", 1.0, 1))
    settings = domain_measurement.DomainSettings(clips, lights, ("naive", "moment:3"))
    options = RestoreOptions(device="cpu")
    with pytest.raises(ValueError, match="was never measured; name weights whose classical scores"):
        domain_measurement.measure(new, settings, options, classical_of=old)
    complete = domain_measurement.measure(old, settings, options)
    restored: list[str] = []
    score = domain_measurement.score

    def noted(method, *others):
        restored.append(method.name)
        return score(method, *others)

    monkeypatch.setattr(domain_measurement, "score", noted)
    assert domain_measurement.measure(new, settings, options, classical_of=old) == complete
    assert set(restored) == {network_restorer(new, options).name}
    with pytest.raises(ValueError, match="not the same: seed"):
        domain_measurement.measure(new, replace(settings, seed=1), options, force=True, classical_of=old)
    dark = replace(settings, lights=(Illumination.of(ppp=0.5),))
    with pytest.raises(ValueError, match=r"holds no cell of .*0\.5"):
        domain_measurement.measure(new, dark, options, classical_of=old)


def cells_without_measuring(monkeypatch: pytest.MonkeyPatch) -> list[Illumination]:
    """Let cells cost nothing; return the list that collects their lights."""
    asked: list[Illumination] = []

    def at_once(network: Restorer, methods: object, settings: object, light: Illumination, rival: object) -> Cell:
        asked.append(light)
        place = domain.place_of(light.device(5e-4), 5e-4, light.ppp)
        return Cell(Path(light.sensor).name, light.ppp, place, 20.0, "naive", 19.0)

    monkeypatch.setattr(domain_measurement, "measure_cell", at_once)
    return asked


def test_cells_of_another_mode_precision_or_cut_are_not_taken(tiny_dataset, tmp_path, monkeypatch):
    """Cells that record none are those of the usual mode and precision."""
    path = tmp_path / "small.safetensors"
    asked = cells_without_measuring(monkeypatch)
    save(QUIVER(SMALL), SMALL, path)
    settings = DomainSettings(domain_measurement.clips_of([tiny_dataset], "test"), (Illumination(),), ("naive",))
    usual = RestoreOptions(device="cpu")
    stored = Domain((cell(3.25, 21.0),), settings.to_dict())
    annotate(path, {domain.KEY: stored.to_json()})
    assert domain_measurement.measure(path, settings, usual).cells == stored.cells
    assert not asked
    for name, options in (
        ("mode", replace(usual, mode="streaming")),
        ("precision", replace(usual, precision="bfloat16")),
    ):
        with pytest.raises(ValueError, match=rf"measured otherwise \(not the same: {name}\)"):
            domain_measurement.measure(path, settings, options)
        found = domain_measurement.measure(path, settings, options, force=True)
        assert found.measured[name] == getattr(options, name)
        assert domain_measurement.measure(path, settings, options) == found
        with pytest.raises(ValueError, match=rf"measured otherwise \(not the same: {name}\)"):
            domain_measurement.measure(path, settings, usual)
        domain_measurement.measure(path, settings, usual, force=True)
    assert len(asked) == 4

    def in_tiles(*given: object) -> Restorer:
        return replace(network_restorer(*given), cut=lambda height, width: "4 tiles of at most 30 x 30")

    monkeypatch.setattr(domain_measurement, "network_restorer", in_tiles)
    with pytest.raises(ValueError, match=r"measured otherwise \(not the same: tiles of a frame\)"):
        domain_measurement.measure(path, settings, usual)


def test_cells_of_an_edited_sensor_file_are_not_taken(tiny_dataset, tmp_path, monkeypatch):
    path = weights(tmp_path)
    asked = cells_without_measuring(monkeypatch)
    light = Illumination.of(sensor_file(tmp_path, QIS, 3), 3.25, 3)
    usual = RestoreOptions(device="cpu")
    settings = DomainSettings(domain_measurement.clips_of([tiny_dataset], "test"), (light,), ("naive",))
    domain_measurement.measure(path, settings, usual)
    named = replace(settings, lights=(Illumination(),))
    assert len(domain_measurement.measure(path, named, usual).cells) == 2  # a named device, too
    domain_measurement.measure(path, settings, usual)
    assert asked == [light, Illumination()]
    sensor_file(tmp_path, QIS.replace("read_noise = 0.2", "read_noise = 0.4"), 3)
    with pytest.raises(ValueError, match=r"measured otherwise \(not the same: sensor file mine\.toml\)"):
        domain_measurement.measure(path, settings, usual)
    domain_measurement.measure(path, named, usual)
    (tmp_path / "other").mkdir()
    both = (light, Illumination.of(sensor_file(tmp_path / "other", QIS, 3), 3.25, 3))
    with pytest.raises(ValueError, match="another sensor file has the same name"):
        domain_measurement.measure(path, replace(settings, lights=both), usual)


def test_a_classical_method_that_fails_does_not_compete(tiny_dataset, tmp_path):
    network = network_restorer(weights(tmp_path), RestoreOptions(device="cpu"))

    def fails(*_: object) -> None:
        raise ValueError("no road leads there")

    broken = replace(restorer("naive"), name="broken", fill=fails)
    settings = domain_measurement.DomainSettings(domain_measurement.clips_of([tiny_dataset], "test"), (Illumination(),))
    assert (
        domain_measurement.measure_cell(network, [broken, restorer("moment:3")], settings, Illumination()).classical
        == "moment:3"
    )
    with pytest.raises(ValueError, match=r"3\.25 PPP, 3 bit: the network, or every classical method, fails"):
        domain_measurement.measure_cell(network, [broken], settings, Illumination())
    with pytest.raises(ValueError, match="no road leads there"):
        domain_measurement.measure_cell(replace(network, fill=fails), [restorer("naive")], settings, Illumination())


def test_the_command_shows_and_measures(capsys, tiny_dataset, tmp_path):
    path = weights(tmp_path)
    code, _, err = run(capsys, "domain", path)
    assert (code, err.count("\n")) == (2, 1)
    assert "was never measured; give clips" in err
    for option in (
        ("--bits", 1),
        ("--seed", 3),
        ("--split", "val"),
        ("--methods", "naive"),
        ("--memory", "1GB"),
        ("--force",),
    ):
        code, _, err = run(capsys, "domain", path, *option)
        assert (code, err.count("\n")) == (2, 1)
        assert f"{option[0]}: is for measuring, and no clips are given" in err
    clip = open_clips(tiny_dataset, "test")[0].path
    code, text, _ = run(capsys, "domain", path, clip, "--methods", "naive", "--bits", "1,3", "--ppp", 2)
    assert code == 0
    assert "| quiver-physical | 1 | 2 |" in text
    assert "of 2 cells" in text
    code, text, _ = run(capsys, "domain", path, "--json")
    assert [c["place"]["bits"] for c in json.loads(text)["domain"]["cells"]] == [1, 3]


def test_an_infinite_score_is_refused_and_a_damaged_domain_measured_again(tiny_dataset, tmp_path, monkeypatch, capsys):
    """Frames without any light have one; it was stored, and the file could never be read again."""
    path = weights(tmp_path)
    scores = iter([20.0, math.inf, 19.0])
    with monkeypatch.context() as patch:
        patch.setattr(domain_measurement, "score", lambda *_: next(scores))
        clips = domain_measurement.clips_of([tiny_dataset], "test")[:1]
        settings = DomainSettings(clips, (Illumination.of(ppp=3.25),), ("naive", "moment:3"))
        with pytest.raises(ValueError, match="or has no score on these clips"):
            domain_measurement.measure(path, settings, RestoreOptions(device="cpu"))
    before = tensors_digest(path)
    annotate(path, {domain.KEY: "{}"})
    cells_without_measuring(monkeypatch)
    words = ["domain", path, tiny_dataset, "--device", "cpu"]
    code, _, said = run(capsys, *words)
    assert code == 2
    assert "measure it again with --force" in said
    assert run(capsys, *words, "--force")[0] == 0
    assert len(domain.read_scope(path, metadata_of(path)).domain.cells) == 1  # type: ignore[union-attr]
    assert tensors_digest(path) == before
