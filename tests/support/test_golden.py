"""The comparison of networks with golden arrays: the rule's check values, errors, and files of other sizes."""

import importlib
import json
import math
from pathlib import Path

import golden_emvd
import golden_memdeblur
import golden_rvrt
import golden_spk2imgnet
import numpy as np
import pytest
import torch
from golden import DATA, compare, cut, errors, fill_value, main, weights_by_table

from quiver.model.rivals.flornn import FloRNN, FloRNNConfig

CHECKS = [  # name, shape, fill, first values, float64 sum (specification, section 1)
    ("vd.fusion.net1.weight", (16, 5, 3, 3), "fan1.2", [0.0729582682, 0.0355579555, -0.273665041], -4.37486063),
    ("mask0.prelu0.weight", (1,), "slope", [0.221128449], 0.221128449),
    ("memory.key_encoder.bn1.running_var", (64,), "one", [1.05713618, 0.882614374, 1.16749477], 63.814401),
    ("upsampling.0.weight", (64, 32, 3, 3), "fan0.8", [-0.0379223488, -0.0245238636, -0.0587641485], -8.52972102),
    ("d.convs.2.weight", (3, 128, 3, 3), "fan0.8", [0.0106919957, -0.0165313464, 0.00490278332], -1.73173221),
    (
        "deform_align.backward_1.conv_offset.10.bias",
        (432,),
        "bias",
        [0.0277926605, -0.00392720802, -0.0361125432],
        -0.240129179,
    ),
]


@pytest.mark.parametrize(("name", "shape", "fill", "first", "total"), CHECKS)
def test_the_rule_gives_the_stated_weights(name, shape, fill, first, total):
    found = fill_value(name, shape, fill, "", {})
    np.testing.assert_allclose(found.ravel()[:3], first, rtol=1e-6)
    assert found.sum(dtype=np.float64) == pytest.approx(total, rel=1e-7)


def test_a_table_gives_every_entry_but_constants(tmp_path):
    table = tmp_path / "table.tsv"
    rows = [
        "# name\tshape\tkind\tfill",
        "a.weight\t2x3\tparameter\tfan1.2",
        "b\tscalar\tbuffer\tzero",
        "c\t4x4\tbuffer\tconst",
        "d.bias\t2\tparameter, unused\tbias",
    ]
    table.write_text("\n".join(rows) + "\n")
    found = weights_by_table(table)
    assert {name: tuple(value.shape) for name, value in found.items()} == {"a.weight": (2, 3), "b": (), "d.bias": (2,)}
    other = weights_by_table(table, prefix="x.")
    assert not torch.equal(found["a.weight"], other["a.weight"])
    with pytest.raises(ValueError, match="the fill of a is odd"):
        fill_value("a", (1,), "odd", "", {})


def test_errors_are_in_units_of_the_deviation():
    golden = {"a": np.array([0.0, 2.0]), "b": np.zeros(3), "c": np.zeros(3), "d": np.ones(2), "e": np.array([math.nan])}
    found = compare({"a": np.array([0.0, 2.5]), "b": np.zeros(4), "c": np.full(3, math.nan), "e": np.ones(1)}, golden)
    assert found == {"a": 0.5, "b": None, "c": None, "d": None, "e": None}


def quiver_codes(*shape: int) -> dict[str, np.ndarray]:
    return {"codes": np.random.default_rng(3).integers(0, 8, shape)}


@pytest.mark.slow
def test_the_program_prints_errors(tmp_path, capsys):
    small = tmp_path / "small.npz"
    table = DATA / "published_state_dict.tsv"
    cut(DATA / "golden_quiver_c16.npz", small, ["codes", "flow4", "out1"])
    assert main(["quiver", str(small), str(table)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() == {"flow4", "out1"}
    assert max(found.values()) < 1e-6


def test_the_program_fails_on_missing_keys(tmp_path, capsys):
    small = tmp_path / "small.npz"
    table = DATA / "published_state_dict.tsv"
    np.savez(small, **quiver_codes(1, 11, 1, 16, 16), strange=np.zeros(3))
    assert main(["quiver", str(small), str(table), "--prefix", "x."]) == 1
    assert json.loads(capsys.readouterr().out) == {"strange": None}


# ---- Files of other sizes


def flows(batch: int, frames: int, height: int, width: int) -> dict[str, np.ndarray]:
    """The other inputs of FloRNN, for a look-ahead of two frames."""
    rng = np.random.default_rng(4)
    return {
        "noise_map": rng.random((batch, frames, 1, height, width)),
        "flow_forward": rng.normal(0, 1.5, (batch, frames + 1, 2, height, width)),
        "flow_backward": rng.normal(0, 1.5, (batch, frames - 1, 2, height, width)),
    }


FLORNN = FloRNNConfig(width=4, blocks=1, look_ahead=2, image_channels=1, flow_channels=(), as_published=True)
OTHERS = {  # a network of small width, and sizes that no golden file has: batch, frames, height, width
    "emvd": (golden_emvd.small, [(2, 1, 8, 24), (2, 5, 16, 8)]),
    "flornn": (lambda: FloRNN(FLORNN), [(2, 3, 9, 14), (2, 5, 12, 7)]),
    "memdeblur": (golden_memdeblur.small, [(2, 1, 8, 20), (2, 7, 12, 16)]),
    "rvrt": (golden_rvrt.small, [(2, 2, 12, 20), (2, 6, 20, 8)]),
    "spk2imgnet": (golden_spk2imgnet.small, [(2, 10, 8, 20), (2, 10, 12, 8)]),
}


def write_table(network: torch.nn.Module, path: Path) -> Path:
    """The table of a network: every entry of its state with a fill."""
    parameters = dict(network.named_parameters())
    rows = []
    for name, value in network.state_dict().items():
        if value.ndim > 1:
            fill = "fan0.8"
        else:
            fill = "one" if name.endswith("running_var") else "bias"
        if name not in parameters and not name.endswith(("running_mean", "running_var")):
            fill = "const"
        rows.append("\t".join((name, "x".join(map(str, value.shape)), "parameter", fill)))
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(("name", "size"), [(name, size) for name, (_, sizes) in OTHERS.items() for size in sizes])
def test_files_of_other_sizes_widths_and_prefixes(tmp_path, capsys, name, size):
    """Two clips together have the stages of each alone; other weights have others."""
    table = write_table(OTHERS[name][0](), tmp_path / "t.tsv")
    path = tmp_path / "g.npz"
    batch, frames, height, width = size
    arrays = {"codes": np.random.default_rng(5).integers(0, 8, (batch, frames, 1, height, width), dtype=np.uint8)}
    arrays |= flows(*size) if name == "flornn" else {}
    network = importlib.import_module(f"golden_{name}")
    weights = weights_by_table(table, "p.")
    with torch.no_grad():
        alone = [network.stages({k: a[i : i + 1] for k, a in arrays.items()}, weights) for i in range(batch)]
    np.savez(path, **arrays, **{key: np.concatenate([stages[key].numpy() for stages in alone]) for key in alone[0]})
    assert main([name, str(path), str(table), "--prefix", "p."]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() == alone[0].keys()
    assert max(found.values()) < 1e-10, found
    assert main([name, str(path), str(table)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["output_full" if name == "memdeblur" else "output"] > 1e-3


def test_files_that_cannot_be_compared_are_one_line(tmp_path, capsys):
    write_table(golden_memdeblur.small(), tmp_path / "t.tsv")
    codes = np.zeros((1, 2, 1, 8, 8), np.uint8)
    good = {"codes": codes, "down_t0": np.zeros(3)}
    (tmp_path / "text.npz").write_text("codes")
    np.save(tmp_path / "one.npy", codes)
    (tmp_path / "odd.tsv").write_text("a.weight\t3xthree\tparameter\tbias\n")
    (tmp_path / "short.tsv").write_text("a.weight 3x3\n")
    files = {
        "no_codes": {"output": codes},
        "flat": good | {"codes": codes[0, 0, 0]},
        "words": good | {"codes": np.array(["a"])},
        "infinite": good | {"codes": np.full((1, 2, 1, 8, 8), np.inf)},
        "inputs": {"codes": codes},
        "good": good,
        "colour": good | {"codes": codes.repeat(4, axis=2)},
        "frames": good | {"codes": codes[:, :, 0]},
        "noise": good | {"noise_ab": np.ones(3)},
        "no_flow": good
        | {
            "flow_forward": np.zeros((1, 3, 2, 8, 8)),
            "flow_backward": np.zeros((1, 1, 3, 8, 8)),
            "noise_map": np.zeros((1, 2, 1, 8, 8)),
        },
        "high": good | {"codes": codes + 8},
        "low": good | {"codes": codes - 1.0},
        "half": good | {"codes": codes + 0.5},
        "eleven": good | {"codes": codes.repeat(11, axis=1)[:, :11]},
        "one_pixel": good | {"codes": codes.repeat(16, axis=3).repeat(17, axis=4)},
        "odd": good | {"codes": codes[:, :1]},
        "emvd": good | {"codes": codes[..., :7], "noise_ab": np.ones(2)},
        "flornn": good
        | {
            "flow_forward": np.zeros((1, 3, 2, 4, 4)),
            "flow_backward": np.zeros((1, 1, 2, 4, 4)),
            "noise_map": np.zeros((1, 2, 1, 8, 8)),
        },
    }
    for name, arrays in files.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
    cases = [
        ("memdeblur", "none.npz", "t.tsv", "none.npz: no such file"),
        ("memdeblur", "text.npz", "t.tsv", "text.npz: not readable as an archive of arrays"),
        ("memdeblur", "one.npy", "t.tsv", "one.npy: not readable as an archive of arrays"),
        ("memdeblur", "no_codes.npz", "t.tsv", "'codes' is missing; give the golden file and the table of memdeblur"),
        ("memdeblur", "flat.npz", "t.tsv", "codes are numbers [B, T, 1, H, W], got uint8 [8, 8]"),
        ("emvd", "colour.npz", "t.tsv", "codes are numbers [B, T, 1, H, W], got uint8 [1, 2, 4, 8, 8]"),
        ("emvd", "frames.npz", "t.tsv", "codes are numbers [B, T, 1, H, W], got uint8 [1, 2, 8, 8]"),
        ("memdeblur", "words.npz", "t.tsv", "codes are numbers"),
        ("memdeblur", "infinite.npz", "t.tsv", "codes are numbers"),
        ("memdeblur", "inputs.npz", "t.tsv", "nothing to compare: the file holds codes alone"),
        ("memdeblur", "good.npz", "none.tsv", "none.tsv: no such file"),
        ("memdeblur", "good.npz", "odd.tsv", "odd.tsv: not readable as a table of names, shapes and kinds"),
        ("memdeblur", "good.npz", "short.tsv", "short.tsv: not readable as a table of names, shapes and kinds"),
        ("spk2imgnet", "good.npz", "t.tsv", "is missing; give the golden file and the table of spk2imgnet"),
        ("flornn", "good.npz", "t.tsv", "is missing; give the golden file and the table of flornn"),
        ("quiver", "good.npz", "t.tsv", "not a published QUIVER checkpoint"),
        ("memdeblur", "high.npz", "t.tsv", "codes are whole numbers 0 to 7, got some of 8 to 8"),
        ("memdeblur", "low.npz", "t.tsv", "codes are whole numbers 0 to 7, got some of -1.0 to -1.0"),
        ("memdeblur", "half.npz", "t.tsv", "codes are whole numbers 0 to 7, got some of 0.5 to 0.5"),
        ("spk2imgnet", "emvd.npz", "t.tsv", "spk2imgnet takes frames whose sides 4 divides, got 8 x 7"),
        ("rvrt", "odd.npz", "t.tsv", "rvrt takes an even number of frames, got 1"),
        ("emvd", "emvd.npz", "t.tsv", "emvd takes frames whose sides 8 divides, got 8 x 7"),
    ]
    for network, file, rows, message in cases:
        assert main([network, str(tmp_path / file), str(tmp_path / rows)]) == 2
        shown = capsys.readouterr()
        assert not shown.out
        assert message in shown.err, (file, shown.err)
        assert shown.err.startswith("golden: ")
        assert shown.err.count("\n") == 1
    rows = write_table(FloRNN(FLORNN), tmp_path / "flornn.tsv")
    for name, message in (
        ("flornn", "flow_forward is [1, 'frames', 2, 8, 8], got [1, 3, 2, 4, 4]"),
        ("no_flow", "flow_backward is [1, 'frames', 2, 8, 8], got [1, 1, 3, 8, 8]"),
    ):
        assert main(["flornn", str(tmp_path / f"{name}.npz"), str(rows)]) == 2
        shown = capsys.readouterr().err
        assert message in shown
        assert shown.count("\n") == 1
    for name, file, message in (
        ("rvrt", "one_pixel", "rvrt takes frames whose sides are at least 132 px, got 128 x 136"),
        ("spk2imgnet", "eleven", "spk2imgnet takes 10 frames, got 11"),
        ("spk2imgnet", "good", "spk2imgnet takes 10 frames, got 2"),
    ):
        rows = DATA / f"{name}_state_dict.tsv"
        assert main([name, str(tmp_path / f"{file}.npz"), str(rows)]) == 2
        assert capsys.readouterr().err == f"golden: {message}\n"
    assert main(["emvd", str(tmp_path / "noise.npz"), str(DATA / "emvd_state_dict.tsv")]) == 2
    assert "noise_ab is the slope and the offset of the noise, got float64 [3]" in capsys.readouterr().err


@pytest.mark.slow
def test_groups_of_frames_change_no_stage(monkeypatch):
    """Large frames run in groups; the stages of a clip are the same."""
    golden = quiver_codes(2, 13, 1, 20, 36)
    table = DATA / "published_state_dict.tsv"
    from golden_quiver import stages

    weights = weights_by_table(table)
    whole = {key: value.numpy() for key, value in stages(golden, weights).items()}
    monkeypatch.setattr("quiver.model.quiver.CHUNK_PIXELS", 2 * 5 * 20 * 36)
    found = errors("quiver", golden | whole, table)
    assert found.keys() == whole.keys()
    assert max(error for error in found.values() if error is not None) < 1e-12
