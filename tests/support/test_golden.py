"""The comparison of networks with golden arrays: the rule's check values, errors, and files of other sizes."""

import json
import math

import numpy as np
import pytest
import torch
from golden import DATA, compare, cut, errors, fill_value, main, weights_by_table

CHECKS = [  # name, shape, fill, first values, float64 sum (specification, section 1)
    ("vd.fusion.net1.weight", (16, 5, 3, 3), "fan1.2", [0.0729582682, 0.0355579555, -0.273665041], -4.37486063),
    ("mask0.prelu0.weight", (1,), "slope", [0.221128449], 0.221128449),
    ("memory.key_encoder.bn1.running_var", (64,), "one", [1.05713618, 0.882614374, 1.16749477], 63.814401),
    ("upsampling.0.weight", (64, 32, 3, 3), "fan0.8", [-0.0379223488, -0.0245238636, -0.0587641485], -8.52972102),
    ("d.convs.2.weight", (3, 128, 3, 3), "fan0.8", [0.0106919957, -0.0165313464, 0.00490278332], -1.73173221),
    ("deform_align.backward_1.conv_offset.10.bias", (432,), "bias", [0.0277926605, -0.00392720802, -0.0361125432],
     -0.240129179),
]  # fmt: skip


@pytest.mark.parametrize(("name", "shape", "fill", "first", "total"), CHECKS)
def test_the_rule_gives_the_stated_weights(name, shape, fill, first, total):
    found = fill_value(name, shape, fill, "", {})
    np.testing.assert_allclose(found.ravel()[:3], first, rtol=1e-6)
    assert found.sum(dtype=np.float64) == pytest.approx(total, rel=1e-7)


def test_a_table_gives_every_entry_but_constants(tmp_path):
    table = tmp_path / "table.tsv"
    rows = ["# name\tshape\tkind\tfill", "a.weight\t2x3\tparameter\tfan1.2", "b\tscalar\tbuffer\tzero",
            "c\t4x4\tbuffer\tconst", "d.bias\t2\tparameter, unused\tbias"]  # fmt: skip
    table.write_text("\n".join(rows) + "\n")
    found = weights_by_table(table)
    assert {name: tuple(value.shape) for name, value in found.items()} == {"a.weight": (2, 3), "b": (), "d.bias": (2,)}
    other = weights_by_table(table, prefix="x.")
    assert not torch.equal(found["a.weight"], other["a.weight"])
    with pytest.raises(ValueError, match="the fill of a is odd"):
        fill_value("a", (1,), "odd", "", {})


def test_errors_are_in_units_of_the_deviation():
    golden = {"a": np.array([0.0, 2.0]), "b": np.zeros(3), "c": np.zeros(3), "d": np.ones(2)}
    found = compare({"a": np.array([0.0, 2.5]), "b": np.zeros(4), "c": np.full(3, math.nan)}, golden)
    assert found == {"a": 0.5, "b": None, "c": None, "d": None}


def quiver_codes(*shape: int) -> dict[str, np.ndarray]:
    return {"codes": np.random.default_rng(3).integers(0, 8, shape)}


def test_the_program_prints_errors_and_fails_on_missing_keys(tmp_path, capsys):
    small, table = tmp_path / "small.npz", DATA / "published_state_dict.tsv"
    cut(DATA / "golden_quiver_c16.npz", small, ["codes", "flow4", "out1"])
    assert main(["quiver", str(small), str(table)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() == {"flow4", "out1"}
    assert max(found.values()) < 1e-6
    np.savez(small, **quiver_codes(1, 11, 1, 16, 16), strange=np.zeros(3))
    assert main(["quiver", str(small), str(table), "--prefix", "x."]) == 1
    assert json.loads(capsys.readouterr().out) == {"strange": None}


@pytest.mark.slow
def test_groups_of_frames_change_no_stage(monkeypatch):
    """Large frames run in groups; the stages of a clip are the same."""
    golden, table = quiver_codes(2, 13, 1, 20, 36), DATA / "published_state_dict.tsv"
    from golden_quiver import stages

    weights = weights_by_table(table)
    whole = {key: value.numpy() for key, value in stages(golden, weights).items()}
    monkeypatch.setattr("quiver.model.quiver.CHUNK_PIXELS", 2 * 5 * 20 * 36)
    found = errors("quiver", golden | whole, table)
    assert found.keys() == whole.keys()
    assert max(error for error in found.values() if error is not None) < 1e-12
