"""A network that restores outside of what it was measured for warns in one line, and is refused with strict."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from clips import ClipMaker
from domains import MEASURED, cell, run, stream, weights
from golden import published_state

import quiver
from qsim.keys import Key
from qsim.sensor import devices
from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.sensor.qis import QIS
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.baselines import METHODS
from quiver.data.clips import open_clips
from quiver.data.codes import Codes, array_codes, light_of
from quiver.data.illumination import Illumination
from quiver.model.published_weights import convert_weights
from quiver.model.weights import annotate, metadata_of
from quiver.restoration import domain, interface
from quiver.restoration.domain import Domain, Scope
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer


def test_inside_nothing_is_said_and_outside_the_better_method():
    scope = Scope(MEASURED)
    assert domain.remark("mine", scope, stream()) is None
    assert domain.remark("mine", scope, stream(ppp=4.0)) is None
    dim = domain.remark("mine", scope, stream(ppp=1.2))
    assert dim == (
        "mine is worse than qbp-bm3d on quiver-physical, 3 bit, 1.2 PPP: qbp-bm3d 20.0 dB, network 15.0 dB "
        "at quiver-physical, 3 bit, 1 PPP"
    )
    others = (stream(bits=1), stream("quiver-published", 1.0), stream("spad512s", 1))
    for far in (stream(ppp=0.5), stream(ppp=100.0), *others):
        said = domain.remark("mine", scope, far)
        assert said is not None
        assert "was never measured near" in said
        assert "qbp-bm3d is mostly the best classical method" in said


def test_light_that_is_not_told_is_estimated():
    """From 12 x 256 codes at 3.25 PPP the mean is known to about 1 %, which decides the nearest cell."""
    told = stream()
    untold = stream(told=False)
    assert untold.ppp is None
    assert light_of(told) == 3.25
    assert light_of(untold) == pytest.approx(3.25, rel=0.1)
    assert domain.remark("mine", Scope(MEASURED), untold) is None
    assert "is worse than" in str(domain.remark("mine", Scope(MEASURED), stream(ppp=26.0, told=False)))


def test_weights_without_cells_say_what_they_were_trained_on(tmp_path):
    path = weights(tmp_path, settings={"sensor": "quiver-physical", "bits": [1, 3], "ppp": [3.25, 9.75]})
    scope = domain.read_scope(path, metadata_of(path))
    assert scope.trained == tuple(Illumination.of("quiver-physical", p, b) for b in (1, 3) for p in (3.25, 9.75))
    same = domain.remark("mine", scope, stream())
    other = domain.remark("mine", scope, stream("spad512s", 2, 1))
    assert same == (
        "mine was never measured against the classical methods; it was trained on such streams "
        "(quiver-physical, 3 bit, 3.25 PPP)"
    )
    assert "it was trained on quiver-physical, 1, 3 bit, 3.25, 9.75 PPP, this stream is spad512s, 1 bit" in str(other)
    assert "does not state what it was trained on" in str(domain.remark("old", Scope(), stream()))
    record = json.dumps(devices.load("spad512s", bits=1).to_dict())
    own = replace(Illumination.of("mine.toml", 2.0, 1), record=record)
    path = weights(tmp_path, settings={"sensor": None, "noise": [own.to_dict(), Illumination().to_dict()]})
    scope = domain.read_scope(path, metadata_of(path))
    assert [light.sensor for light in scope.trained] == ["mine.toml", "quiver-physical"]
    assert "trained on such streams" in str(domain.remark("mine", scope, stream("spad512s", 2, 1)))
    assert "trained on such streams" in str(domain.remark("mine", scope, stream()))
    assert "this stream is" in str(domain.remark("mine", scope, stream(bits=2)))
    several = {"sensor": ["quiver-physical", "none.toml"], "bits": [3], "ppp": [1]}
    path = weights(tmp_path, settings=several)
    assert len(domain.read_scope(path, metadata_of(path)).trained) == 2
    assert "none.toml" in str(domain.remark("m", domain.read_scope(path, metadata_of(path)), stream("spad512s", 2, 1)))


def test_restore_warns_in_one_line_and_refuses_with_strict(capsys, tiny_dataset, tmp_path):
    path = weights(tmp_path, MEASURED)
    clip = open_clips(tiny_dataset, "test")[0].path
    words = ("restore", clip, "-o", tmp_path / "r.npy", "--method", path, "--ppp")
    code, _, err = run(capsys, *words, 26, "--strict")
    assert code == 2
    assert err.startswith("quiver: small is worse than qbp-bm3d on quiver-physical, 3 bit, 26 PPP")
    assert err.count("\n") == 1
    assert not list(tmp_path.glob("r.*"))
    code, _, err = run(capsys, *words, 26)
    assert code == 0
    assert err.count("quiver: warning: small is worse than qbp-bm3d") == 1
    code, _, err = run(capsys, *words, 26, "--force", "-q")
    assert (code, err) == (0, "")
    code, _, err = run(capsys, *words, 3.25, "--force", "--strict")
    assert code == 0
    assert "warning" not in err
    code, _, err = run(capsys, *words, 3.25, "--force", "-v")
    assert "small was measured at quiver-physical, 3 bit, 3.25 PPP: qbp-bm3d 20.0 dB, network 25.0 dB" in err
    code, _, err = run(capsys, "restore", clip, "-o", tmp_path / "s.npy", "--method", "naive", "--ppp", 3, "--strict")
    assert code == 2
    assert "--strict: acts on networks, and naive is classical" in err


def test_strict_lets_a_classical_method_pass_that_auto_chose(capsys, tmp_path, make_clip: ClipMaker):
    """With the options of networks too: a script that gives them always does not depend on the stream."""
    bracketed = sense(
        make_clip(frames=4, height=16, width=16), Sensing("quiver-physical", bits=3, ppp=3.25, exposures=(1.0, 0.25))
    )[0]
    words = (
        "restore",
        bracketed.path,
        "-o",
        tmp_path / "r.npy",
        "--strict",
        "--device",
        "cpu",
        "--precision",
        "float32",
    )
    code, _, err = run(capsys, *words)
    assert code == 0, err
    assert "auto: likelihood" in err
    assert run(capsys, *words, "--force", "--mode", "exact")[0] == 2


def test_restore_checks_a_bare_array_with_its_sensor(capsys, tmp_path):
    path = weights(tmp_path, MEASURED)
    np.save(tmp_path / "codes.npy", stream("spad-320x240", 1.0, 1).read(0, 12))
    words = ("restore", tmp_path / "codes.npy", "-o", tmp_path / "r.npy", "--method", path, "--bits", 1)
    code, _, err = run(capsys, *words, "--sensor", "spad-320x240", "--strict")
    assert code == 2
    assert "small was never measured near spad-320x240, 1 bit, " in err
    assert not (tmp_path / "r.npy").exists()


def test_evaluate_warns_in_its_table_and_refuses_with_strict(capsys, tiny_dataset, tmp_path):
    path = weights(tmp_path, MEASURED)
    out = tmp_path / "table"
    words = ("evaluate", tiny_dataset, "-o", out, "--methods", f"naive,{path}", "--ppp", "3.25,26")
    code, _, err = run(capsys, *words, "--strict")
    assert code == 2
    assert not out.exists()
    code, text, err = run(capsys, *words)
    assert code == 0
    assert err.count("quiver: warning: small is worse than qbp-bm3d on quiver-physical, 3 bit, 26 PPP") == 1
    assert "small is worse than qbp-bm3d" in text
    assert "small is worse than qbp-bm3d" in (out / "evaluation.md").read_text()
    assert json.loads((out / "evaluation.json").read_text())["remarks"][0].startswith("small is worse")
    counts = np.random.default_rng(3).poisson(1.0, (14, 16, 16))
    np.save(tmp_path / "counts.npy", counts)
    static = ("evaluate", "--static", tmp_path / "counts.npy", "--methods", path, "--splits", 1)
    code, _, err = run(capsys, *static, "--strict")
    assert code == 2
    assert "small was never measured near ideal counter, 3 bit, 0.9" in err or "3 bit, 1" in err
    assert run(capsys, *static)[0] == 0


def test_another_mode_or_precision_than_that_of_the_cells_is_told():
    """Cells name what was not usual; classical methods and networks without cells have nothing to compare."""
    inside = stream()
    usual = {"mode": "exact", "precision": "float32"}
    assert said_of(MEASURED, usual, inside) == said_of(MEASURED, {"mode": None, "precision": "float32"}, inside) == []
    streamed = replace(MEASURED, measured={**MEASURED.measured, "mode": "streaming"})
    assert said_of(streamed, usual | {"mode": "streaming"}, inside) == []
    told = "mine was measured in exact and float32, and runs in streaming and float32: nothing tells how well"
    assert said_of(MEASURED, usual | {"mode": "streaming"}, inside) == [told]
    assert said_of(streamed, usual, inside) != []
    assert said_of(MEASURED, usual | {"precision": "bfloat16"}, inside) != []


def said_of(found: Domain, identity: dict[str, object], codes: Codes) -> list[str]:
    return interface.remarks([Restorer("mine", 11, 5, True, "", nothing, identity=identity, scope=Scope(found))], codes)


def nothing(codes: Codes, out: np.ndarray, first: int, progress: object) -> None: ...


def test_the_call_in_python_warns_and_refuses_with_strict(tmp_path, make_clip: ClipMaker):
    path = weights(tmp_path, MEASURED)
    codes = stream(ppp=26.0)
    array = codes.read(0, 12)
    known = {"sensor": codes.sensor, "exposure": codes.exposure}
    with pytest.warns(UserWarning, match="small is worse than qbp-bm3d on QIS, 3 bit"):
        found = quiver.restore(array, str(path), **known)
    assert found.shape == array.shape
    with pytest.raises(ValueError, match="small is worse than qbp-bm3d"):
        quiver.restore(array, str(path), strict=True, **known)
    inside = stream()
    quiver.restore(inside.read(0, 12), str(path), strict=True, sensor=inside.sensor, exposure=5e-4)
    with pytest.raises(ValueError, match="strict=: acts on networks"):
        quiver.restore(array, "naive", strict=True, **known)


def test_a_sensor_whose_codes_tell_no_light_still_has_a_remark():
    """A full well of a hundredth of an electron: the moment inverse refuses it, the remark does not."""
    sensor = QIS(0.8, 1.6, 0.2, 3, gain=0.5, full_well=0.01)
    codes = array_codes(np.zeros((3, 8, 8), np.uint8), sensor, 5e-4)
    with pytest.raises(ValueError, match="does not"):
        METHODS["moment"].restore(codes.read(0, 3), sensor, 5e-4)
    assert light_of(codes) > 0


def test_converted_weights_have_light_up_to_a_factor(tmp_path):
    """Also where they were measured to be best; weights that were trained here have light in photons."""
    source = tmp_path / "their.pth"
    path = tmp_path / "small.safetensors"
    torch.save(published_state(), source)
    convert_weights(source, path)
    clause = "restored light is right up to a factor, as the published program learns grey / 255"
    (text,) = interface.remarks([restorer(str(path))], stream())
    assert text.startswith("small was never measured against the classical methods")
    assert text.endswith(f"; {clause}")
    annotate(path, {domain.KEY: MEASURED.to_json()})
    assert interface.remarks([restorer(str(path))], stream()) == [f"small was converted; {clause}"]
    own = restorer(str(weights(tmp_path)))
    assert "up to a factor" not in str(interface.remarks([own], stream()))


def test_darkness_is_told_without_a_number():
    dark = array_codes(
        np.zeros((5, 32, 32), np.uint8), devices.load("quiver-physical", ppp=3.25, bits=3, exposure=5e-4), 5e-4
    )
    for scope in (Scope(MEASURED), Scope()):
        assert domain.remark("mine", scope, dark) == (
            "mine was never measured in such darkness: the codes tell no light"
        )


def test_light_that_changes_is_told():
    device = devices.load("quiver-physical", ppp=3.25, bits=3, exposure=5e-4)
    for change, said in ((0.0, False), (0.5, True)):
        light = 3.25 * (1 + change * np.linspace(-0.5, 0.5, 11))[:, None, None] * np.ones((1, 64, 64))
        codes = replace(array_codes(device.sample(light, 5e-4, key=Key(1, 1)), device, 5e-4), ppp=3.25)
        text = str(domain.remark("mine", Scope(MEASURED), codes))
        assert ("mine was never trained on light that changes, here by at least " in text) == said


def test_dark_counts_and_few_frames_are_told():
    """In the middle of the measured cells: the sensor makes a fifth of the light itself, or there are three frames."""
    scope = Scope(MEASURED)
    plain = stream()
    assert domain.remark("mine", scope, plain) is None
    noisy = replace(plain, sensor=plain.sensor.with_dark_rate(0.2 * 3.25 * plain.sensor.efficiency / plain.exposure))
    assert "never measured where dark counts are 20 % of the mean light" in str(domain.remark("mine", scope, noisy))
    far = str(domain.remark("mine", scope, stream("quiver-published", 1.0)))  # 1.6 dark electrons, 0.8 of light
    assert "was never measured near quiver-published, 3 bit, 1 PPP" in far
    assert far.endswith("dark counts are 200 % of the mean light, and dark places may become too bright")
    assert "dark" not in str(domain.remark("mine", scope, stream(ppp=100.0)))
    for frames, words in (
        (1, "one frame of 3 bit: its brightness may be wrong by up to 30 %"),
        (3, "3 frames of 3"),
    ):
        few = replace(plain, shape=(frames, *plain.shape[1:]))
        assert f"little to go by in {words}" in str(domain.remark("mine", scope, few))
    assert domain.remark("mine", scope, replace(plain, shape=(4, *plain.shape[1:]))) is None
    binary = Scope(Domain((cell(1.0, 25.0, bits=1, sensor="spad-320x240"),), {}))
    for frames, words in ((1, "30 %"), (4, "12 %"), (10, "12 %"), (11, None)):
        few = stream("spad-320x240", 1.0, 1)
        text = domain.remark("mine", binary, replace(few, shape=(frames, *few.shape[1:])))
        assert text is None if words is None else text is not None and text.endswith(words)


def test_each_colour_of_a_mosaic_is_judged_at_its_own_light():
    """White pixels get the light of three bands, and the pixels of every place are restored alone."""
    only = Domain((cell(3.25, 25.0),), {})
    mosaic = replace(stream(), colour=ColourFilter(MASKS["rgbw"]))
    (said,) = said_of(only, {}, mosaic)
    assert "mine was never measured near quiver-physical, 3 bit, 9.75 PPP" in said
    assert said_of(only, {}, replace(mosaic, colour=ColourFilter(MASKS["rggb"]))) == []
    both = Domain((*only.cells, cell(9.75, 18.0)), {})
    found = said_of(both, {}, replace(mosaic, sensor=devices.load("quiver-physical", ppp=9.75, bits=3)))
    assert len(found) == 2
    assert "never measured near quiver-physical, 3 bit, 3.25 PPP" in found[0]
    assert "mine is worse than qbp-bm3d on quiver-physical, 3 bit, 9.75 PPP" in found[1]
