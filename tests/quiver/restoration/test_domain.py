"""Weights know their domain: cells are measured, stored, found again, and said in one line where they speak against."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker
from safetensors import safe_open

import quiver
from qsim.sensor import devices
from qsim.sensor.qis import QIS
from quiver.baselines import METHODS
from quiver.cli.program import main
from quiver.data.clips import open_clips
from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import Illumination
from quiver.data.noise import Noise
from quiver.evaluation import domain_measurement
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import annotate, load, metadata_of, save
from quiver.restoration import domain
from quiver.restoration.domain import Cell, Domain, OperatingPoint, Scope
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import network_restorer, network_title
from quiver.restoration.restorers import PRETRAINED, restorer

NANO_TENSORS = "6a63ccb037b3b58e691acd1cc99acfc15ca5803003a647be778a7d7d36d2ab31"  # as they were trained


def cell(ppp: float, network: float, *, bits: int = 3, sensor: str = "quiver-physical", best: float = 20.0) -> Cell:
    seen = devices.load(sensor, ppp=ppp, bits=bits, exposure=5e-4)
    return Cell(sensor, ppp, domain.place_of(seen, 5e-4, ppp), network, "qbp-bm3d", best)


MEASURED = Domain((cell(1.0, 15.0), cell(3.25, 25.0), cell(26.0, 18.0)), {"clips": ["gears"], "seed": 0})


def stream(sensor: str = "quiver-physical", ppp: float = 3.25, bits: int = 3, told: bool = True) -> Codes:
    """Codes of even light [12, 16, 16] that say, or do not say, how bright it was."""
    seen = devices.load(sensor, ppp=ppp, bits=bits, exposure=5e-4)
    rng = np.random.default_rng(0)
    codes = (
        seen.codes_of(rng.poisson(ppp * seen.efficiency, (12, 16, 16)))
        if hasattr(seen, "codes_of")
        else (rng.binomial(seen.levels - 1, -math.expm1(-ppp * seen.efficiency / (seen.levels - 1)), (12, 16, 16)))
    )
    found = array_codes(codes.astype(np.uint8), seen, 5e-4)
    return replace(found, ppp=ppp, sensor_name=sensor) if told else found


def weights(folder: Path, found: Domain | None = None, settings: dict[str, object] | None = None) -> Path:
    """A small network's file, with a domain and with settings of its training."""
    path = folder / "small.safetensors"
    network = UNet(UNetConfig(2))
    notes = {} if settings is None else {"settings": json.dumps(settings)}
    save(network, network.config, path, notes if found is None else notes | {domain.KEY: found.to_json()})
    return path


def tensors_digest(path: Path) -> str:
    found = hashlib.sha256()
    with safe_open(path, "np") as file:
        for name in sorted(file.keys()):
            value = file.get_tensor(name)
            found.update(f"{name} {value.dtype} {value.shape}".encode())
            found.update(value.tobytes())
    return found.hexdigest()


# ---- Which cell speaks for a stream


def test_inside_nothing_is_said_and_outside_the_better_method():
    scope = Scope(MEASURED)
    assert domain.remark("nano", scope, stream()) is None
    assert domain.remark("nano", scope, stream(ppp=4.0)) is None
    dim = domain.remark("nano", scope, stream(ppp=1.2))
    assert dim == (
        "nano is worse than qbp-bm3d on quiver-physical, 3 bit, 1.2 PPP: qbp-bm3d 20.0 dB, network 15.0 dB "
        "at quiver-physical, 3 bit, 1 PPP"
    )
    for far in (stream(ppp=0.5), stream(ppp=100.0), stream(bits=1), stream("quiver-paper", 1.0), stream("spad512s", 1)):
        said = domain.remark("nano", scope, far)
        assert said is not None
        assert "was never measured near" in said
        assert "qbp-bm3d is mostly the best classical method" in said


def test_the_nearest_cell_is_the_nearest_in_log_light():
    """Against a search over all cells of the same kind, for random grids and streams."""
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(300):
        lights = np.exp(rng.uniform(-2, 5, rng.integers(1, 7)))
        bits = [int(b) for b in rng.integers(1, 4, len(lights))]
        cells = tuple(cell(float(p), 1.0, bits=b) for p, b in zip(lights, bits, strict=True))
        ppp, own = float(np.exp(rng.uniform(-2.5, 5.5))), int(rng.integers(1, 4))
        place = domain.place_of(devices.load("quiver-physical", ppp=ppp, bits=own), 5e-4, ppp)
        same = [c.ppp for c in cells if c.place.bits == own]
        found = Domain(cells, {}).nearest(place)
        if not same or not min(same) / domain.NEAR <= ppp <= max(same) * domain.NEAR:
            assert found is None
            continue
        inside += 1
        assert abs(math.log(found.ppp / ppp)) == pytest.approx(min(abs(math.log(p / ppp)) for p in same))
    assert inside > 30


def test_sensors_of_one_kind_share_their_cells_in_detected_photons():
    """A clocked SPAD of half the efficiency in twice the light gives the same codes."""
    spad = Domain((cell(2.0, 25.0, bits=1, sensor="spad-320x240"),), {})
    other = devices.load("spad512s", bits=1)
    assert spad.nearest(domain.place_of(other, 5e-4, 2.0 / other.efficiency)) is not None
    assert spad.nearest(domain.place_of(other, 5e-4, 2.0)) is None


def test_light_that_is_not_told_is_estimated():
    """From 12 x 256 codes at 3.25 PPP: the mean is known to a percent or so, the nearest cell surely."""
    told, untold = stream(), stream(told=False)
    assert untold.ppp is None
    assert domain.light_of(told) == 3.25
    assert domain.light_of(untold) == pytest.approx(3.25, rel=0.1)
    assert domain.remark("nano", Scope(MEASURED), untold) is None
    assert "is worse than" in str(domain.remark("nano", Scope(MEASURED), stream(ppp=26.0, told=False)))


def test_weights_without_cells_say_what_they_were_trained_on(tmp_path):
    path = weights(tmp_path, settings={"sensor": "quiver-physical", "bits": [1, 3], "ppp": [3.25, 9.75]})
    scope = domain.read_scope(path, metadata_of(path))
    assert scope.trained == tuple(Illumination("quiver-physical", p, b) for b in (1, 3) for p in (3.25, 9.75))
    same, other = domain.remark("mine", scope, stream()), domain.remark("mine", scope, stream("spad512s", 2, 1))
    assert same == (
        "mine was never measured against the classical methods; it was trained on such streams "
        "(quiver-physical, 3 bit, 3.25 PPP)"
    )
    assert "it was trained on quiver-physical, 1, 3 bit, 3.25, 9.75 PPP, this stream is spad512s, 1 bit" in str(other)
    assert "does not say what it was trained on" in str(domain.remark("old", Scope(), stream()))
    own = Noise("mine.toml", 2.0, 1, record=json.dumps(devices.load("spad512s", bits=1).to_dict()), lux=None)
    path = weights(tmp_path, settings={"sensor": None, "noise": [own.to_dict(), Noise().to_dict()]})
    scope = domain.read_scope(path, metadata_of(path))
    assert [light.sensor for light in scope.trained] == ["mine.toml", "quiver-physical"]
    assert "trained on such streams" in str(domain.remark("mine", scope, stream("spad512s", 2, 1)))
    assert "trained on such streams" in str(domain.remark("mine", scope, stream()))
    assert "this stream is" in str(domain.remark("mine", scope, stream(bits=2)))
    several = {"sensor": ["quiver-physical", "none.toml"], "bits": [3], "ppp": [1]}
    path = weights(tmp_path, settings=several)
    assert len(domain.read_scope(path, metadata_of(path)).trained) == 2
    assert "none.toml" in str(domain.remark("m", domain.read_scope(path, metadata_of(path)), stream("spad512s", 2, 1)))


# ---- The file


def test_a_domain_survives_its_file():
    assert Domain.from_json(MEASURED.to_json()) == MEASURED


def test_a_damaged_domain_is_one_line(tmp_path):
    """Any value replaced by one of another kind, keys gone, text cut: read alike, or a `ValueError` in one line."""
    good, rng, refused = json.loads(MEASURED.to_json()), np.random.default_rng(2), 0
    values = [None, True, "x", -1, 0, 1e400, math.nan, [], {}, [1], 10**400, "1"]
    for _ in range(300):
        found = json.loads(json.dumps(good))
        spot = [found, found["cells"][0], found["cells"][0]["place"]][int(rng.integers(3))]
        name = str(rng.choice(list(spot)))
        if rng.random() < 0.2:
            del spot[name]
        else:
            spot[name] = values[int(rng.integers(len(values)))]
        text = json.dumps(found)
        text = text[: int(rng.integers(len(text)))] if rng.random() < 0.2 else text
        try:
            Domain.from_json(text)
        except ValueError:
            refused += 1
    assert refused > 200
    path = weights(tmp_path)
    annotate(path, {domain.KEY: "{}"})
    with pytest.raises(ValueError, match=r"small\.safetensors: its domain is damaged .*`quiver domain`"):
        network_restorer(path, RestoreOptions(device="cpu"))


def test_notes_leave_the_tensors_alone(tmp_path):
    path = weights(tmp_path, settings={"seed": 5})
    before, settings = tensors_digest(path), metadata_of(path)["settings"]
    annotate(path, {domain.KEY: MEASURED.to_json()})
    assert tensors_digest(path) == before
    assert metadata_of(path)["settings"] == settings
    assert domain.read_scope(path, metadata_of(path)).domain == MEASURED
    assert isinstance(load(path), UNet)
    (tmp_path / "other.safetensors").write_bytes(b"12345678")
    with pytest.raises(ValueError, match="not a safetensors file"):
        annotate(tmp_path / "other.safetensors", {})


# ---- Measuring


def test_cells_are_measured_stored_and_kept(tiny_dataset, tmp_path, monkeypatch):
    path = weights(tmp_path)
    before = tensors_digest(path)
    clips = domain_measurement.clips_of([tiny_dataset], "test")
    lights = (Illumination(ppp=3.25), Illumination("spad-320x240", 1.0, 1))
    settings = domain_measurement.DomainSettings(clips, lights, ("naive", "moment:3"))
    asked: list[Illumination] = []
    measured = domain_measurement.measure_cell

    def noted(network, methods, settings, light):
        asked.append(light)
        return measured(network, methods, settings, light)

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
    assert (own.network < own.classical_psnr) != own.wins  # random weights

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
    with pytest.raises(ValueError, match="measured against classical methods, got nano"):
        domain_measurement.measure(path, replace(settings, methods=("nano",)), RestoreOptions(device="cpu"))
    with pytest.raises(ValueError, match="unknown split 'none'"):
        domain_measurement.clips_of([tiny_dataset], "none")


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


# ---- Commands and the call in Python


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_restore_warns_in_one_line_and_refuses_with_strict(capsys, tiny_dataset, tmp_path):
    path, clip = weights(tmp_path, MEASURED), open_clips(tiny_dataset, "test")[0].path
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
    assert "strict: acts on networks, and naive is classical" in err


def test_restore_checks_a_bare_array_with_its_sensor(capsys, tmp_path):
    path = weights(tmp_path, MEASURED)
    np.save(tmp_path / "codes.npy", stream("spad-320x240", 1.0, 1).read(0, 12))
    words = ("restore", tmp_path / "codes.npy", "-o", tmp_path / "r.npy", "--method", path, "--bits", 1)
    code, _, err = run(capsys, *words, "--sensor", "spad-320x240", "--strict")
    assert code == 2
    assert "small was never measured near spad-320x240, 1 bit, " in err
    assert not (tmp_path / "r.npy").exists()


def test_evaluate_warns_in_its_table_and_refuses_with_strict(capsys, tiny_dataset, tmp_path):
    path, out = weights(tmp_path, MEASURED), tmp_path / "table"
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


def test_the_call_in_python_warns_and_refuses_with_strict(tmp_path, make_clip: ClipMaker):
    path, codes = weights(tmp_path, MEASURED), stream(ppp=26.0)
    array, known = codes.read(0, 12), {"sensor": codes.sensor, "exposure": codes.exposure}
    with pytest.warns(UserWarning, match="small is worse than qbp-bm3d on QIS, 3 bit"):
        found = quiver.restore(array, str(path), **known)
    assert found.shape == array.shape
    with pytest.raises(ValueError, match="small is worse than qbp-bm3d"):
        quiver.restore(array, str(path), strict=True, **known)
    inside = stream()
    quiver.restore(inside.read(0, 12), str(path), strict=True, sensor=inside.sensor, exposure=5e-4)
    with pytest.raises(ValueError, match="strict: acts on networks"):
        quiver.restore(array, "naive", strict=True, **known)


def test_the_command_shows_and_measures(capsys, tiny_dataset, tmp_path):
    path = weights(tmp_path)
    code, _, err = run(capsys, "domain", path)
    assert (code, err.count("\n")) == (2, 1)
    assert "was never measured; name clips" in err
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
        assert f"{option[0]}: is of measuring, and no clips are named" in err
    clip = open_clips(tiny_dataset, "test")[0].path
    code, text, _ = run(capsys, "domain", path, clip, "--methods", "naive", "--bits", "1,3", "--ppp", 2)
    assert code == 0
    assert "| quiver-physical | 1 | 2 |" in text
    assert "of 2 cells" in text
    code, text, _ = run(capsys, "domain", path, "--json")
    assert [c["place"]["bits"] for c in json.loads(text)["domain"]["cells"]] == [1, 3]


# ---- What ships


def test_the_shipped_weights_are_those_that_were_trained():
    """Notes were added later; the tensors are the same, bit for bit, and the file stays small."""
    path = PRETRAINED / "nano.safetensors"
    assert tensors_digest(path) == NANO_TENSORS
    assert path.stat().st_size < 5_000_000
    assert network_title(load(path)) == "nano (U-Net on aligned frames)"


def test_the_shipped_weights_know_their_domain():
    """Measured cells, not typed ones: the page shows what the file holds, and light it fails at is named."""
    path = PRETRAINED / "nano.safetensors"
    scope = domain.read_scope(path, metadata_of(path))
    page = (Path(__file__).parents[3] / "docs/results/domain.md").read_text(encoding="utf-8")
    assert "\n".join(domain.table(scope.domain)) in page
    assert domain.remark("nano", scope, stream()) is None
    assert "nano is worse than qbp-bm3d on quiver-physical, 3 bit, 0.5 PPP" in str(
        domain.remark("nano", scope, stream(ppp=0.5))
    )
    assert "is worse than" in str(domain.remark("nano", scope, stream(bits=1)))
    assert "never measured near" in str(domain.remark("nano", scope, stream(bits=4)))


def test_places_of_one_gain_are_alike():
    one = OperatingPoint("QIS", 3, 2.6, 6.5)
    assert one.like(OperatingPoint("QIS", 3, 26.0, 65.0))  # the same in units of the light
    assert one.like(OperatingPoint("QIS", 3, 1.0, 6.0))  # about the same in photons
    assert not one.like(OperatingPoint("QIS", 3, 1.0, 10.0))
    assert not one.like(OperatingPoint("QIS", 2, 2.6, 6.5))
    assert not one.like(OperatingPoint("BinarySPAD", 3, 2.6, 6.5))


def test_a_sensor_whose_codes_tell_no_light_still_has_a_remark():
    """A full well of a hundredth of an electron: the moment inverse refuses, the warning must not."""
    sensor = QIS(0.8, 1.6, 0.2, 3, gain=0.5, full_well=0.01)
    codes = array_codes(np.zeros((3, 8, 8), np.uint8), sensor, 5e-4)
    with pytest.raises(ValueError, match="does not"):
        METHODS["moment"].restore(codes.read(0, 3), sensor, 5e-4)
    assert domain.light_of(codes) > 0
