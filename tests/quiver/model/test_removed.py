"""Everything of `nano`, a network that was removed, is refused in one line that names the last commit that reads it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from golden import TINY
from safetensors.torch import save_file

import quiver
from qsim.sensor import devices
from quiver.cli.program import main
from quiver.evaluation.cost import checked_cases
from quiver.model.presets import build
from quiver.model.removed import LAST_COMMIT, RemovedError, refuse_run
from quiver.model.weights import EARLIER, load, save

# The configuration with which nano was written, last as FoldedQUIVER, before as QUIVER with earlier names of fields.
SIZES = {"channels": 4, "deformable_groups": 1, "deformable_kernel": 1, "denoiser_growth": 4, "denoiser_passes": 1,
         "flow_channels": [8, 8], "flow_kernel": 3, "flow_levels": 3, "cell_blocks": 1, "attention_width": 32,
         "attention_temperature": 8.0, "fold": 2, "lecun": True, "cell_growth": None, "pre_denoiser": True,
         "flow": True, "multi_scale": True}  # fmt: skip
FORMS = {
    "last": ("FoldedQUIVER", SIZES | {"estimate_width": 32, "largest_velocity": 7.0}),
    "earlier": ("QUIVER", SIZES | {"baseline": 32, "sweep": 7.0}),
    "one field": ("QUIVER", TINY.to_dict() | EARLIER | {"fold": 2}),
    "no fields": ("FoldedQUIVER", {}),
}
CODES = np.zeros((12, 16, 16), np.uint8)


def write_weights(path: Path, form: str = "last") -> Path:
    kind, config = FORMS[form]
    path.parent.mkdir(exist_ok=True)
    about = {"format": "quiver-1", "network": kind, "config": json.dumps(config), "step": "9"}
    save_file({"estimate.weights": torch.ones(11)}, path, about)
    return path


def write_run(folder: Path, network: str = "nano") -> Path:
    """A finished run, as far as it is read before it is refused."""
    write_weights(folder / "best.safetensors")
    (folder / "settings.json").write_text(json.dumps({"network": network, "head_start": 0.85, "threads": 1}))
    (folder / "checkpoint.pt").write_bytes(b"state")
    return folder


def one_line(text: str) -> bool:
    return text.strip().count("\n") == 0 and LAST_COMMIT in text and "use mergenet" in text


def test_the_commit_is_a_commit():
    assert re.fullmatch(r"[0-9a-f]{7,40}", LAST_COMMIT)
    assert int(LAST_COMMIT, 16) > 0


@pytest.mark.parametrize("form", FORMS)
def test_weights_are_refused(tmp_path, form):
    path = write_weights(tmp_path / "w.safetensors", form)
    with pytest.raises(RemovedError) as told:
        load(path)
    assert one_line(str(told.value))
    assert str(told.value).startswith(f"{path}: weights of nano")


@pytest.mark.parametrize("given", ["run", "run/best.safetensors", "no weights yet", "nano"])
@pytest.mark.parametrize(
    "command",
    [
        "train DATA -o new --preset mergenet --steps 1 --start GIVEN",
        "restore codes.npy --sensor quiver-paper -o r.npy --method GIVEN",
        "evaluate DATA -o table --methods naive,GIVEN",
        "bench --methods GIVEN --size 16x16 -o costs",
        "domain GIVEN",
        "domain GIVEN DATA",
    ],
)
def test_commands_refuse_it(capsys, tiny_dataset, tmp_path, monkeypatch, command, given):
    """Exit code 2, one line, and nothing written."""
    monkeypatch.chdir(tmp_path)
    np.save("codes.npy", CODES)
    write_run(tmp_path / "run")
    (write_run(tmp_path / "no weights yet") / "best.safetensors").unlink()
    before = sorted(tmp_path.rglob("*"))
    names = {"DATA": str(tiny_dataset), "GIVEN": given}
    assert main([*(names.get(word, word.replace("GIVEN", given)) for word in command.split()), "-q"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert one_line(err), err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("preset", ["mergenet", "quiver-s", "unet"])
def test_a_run_is_not_resumed(capsys, tiny_dataset, tmp_path, preset):
    folder = write_run(tmp_path / "run")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(["train", str(tiny_dataset), "-o", str(folder), "--preset", preset, "--steps", "1", "-q"]) == 2
    err = capsys.readouterr().err
    assert f"{folder}: a training run of nano" in err
    assert one_line(err)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_an_ablation_is_not_resumed(capsys, tiny_dataset, tmp_path):
    for name in ("none", "all"):
        write_run(tmp_path / name, f"nano {name}")
    assert main(["ablate", str(tiny_dataset), "-o", str(tmp_path), "--steps", "1", "-q"]) == 2
    assert one_line(capsys.readouterr().err)


@pytest.mark.parametrize("found", [{"network": "nanometre"}, {"network": "mergenet"}, {"network": None}, {}])
def test_a_run_of_another_network_is_not_taken_for_it(tmp_path, found):
    (tmp_path / "settings.json").write_text(json.dumps(found))
    refuse_run(tmp_path)
    refuse_run(tmp_path / "absent")


def test_force_replaces_such_a_run(tiny_dataset, tmp_path):
    folder = write_run(tmp_path / "run")
    words = ["--preset", "unet", "--protocol", "control", "--steps", "1", "--crop", "16", "--batch", "1", "--force"]
    assert main(["train", str(tiny_dataset), "-o", str(folder), *words, "-q"]) == 0
    assert json.loads((folder / "settings.json").read_text())["network"] == "unet"


@pytest.mark.parametrize("command", ["train", "ablate"])
def test_the_preset_names_what_to_use(capsys, command):
    assert main([command, "data", "-o", "x", "--preset", "nano"]) == 2
    err = capsys.readouterr().err
    assert "argument --preset: the network nano was removed" in err
    assert one_line(err)


def test_calls_from_python_refuse_it(tmp_path):
    sensor = devices.load("quiver-paper", ppp=3.25, bits=3, exposure=5e-4)
    run = str(write_run(tmp_path / "run"))
    calls = [
        lambda: build("nano"),
        lambda: checked_cases(["nano"], None, None, None),
        *(lambda name=name: quiver.restore(CODES, name, sensor=sensor, exposure=5e-4) for name in ("nano", run)),
    ]
    for call in calls:
        with pytest.raises(RemovedError) as told:
            call()
        assert one_line(str(told.value))


def test_converting_it_is_refused_as_are_weights_that_need_none(capsys, tmp_path):
    path = write_weights(tmp_path / "w.safetensors")
    words = ["convert-weights", str(path), "-o", str(tmp_path / "new.safetensors")]
    assert main(words) == 2
    assert one_line(capsys.readouterr().err)
    network = build("unet-1m")
    save(network, network.config, path)
    assert main(words) == 2
    assert "holds weights of this program; they need no conversion" in capsys.readouterr().err
    assert not (tmp_path / "new.safetensors").exists()
