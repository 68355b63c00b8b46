"""The bench: a clip that never changes, cases that differ. Costs: tests/quiver/cli/test_program.py (slow)."""

from __future__ import annotations

import json
import math
import multiprocessing
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from golden import SMALL

from quiver.cli.program import main
from quiver.evaluation import cost as costs
from quiver.evaluation.cost import (
    CostCase,
    CostRow,
    CostSettings,
    cases_of,
    checked_cases,
    device_of,
    fixed_clip,
    markdown,
    measure,
)
from quiver.model.names import NETWORKS
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import save
from quiver.restoration.interface import Restorer


def test_the_clip_is_fixed_and_as_bright_as_asked():
    settings = CostSettings(height=20, width=28, frames=5, ppp=3.25)
    codes, photons = fixed_clip(settings)
    assert photons.mean() == 3.25
    assert photons.min() > 0
    np.testing.assert_array_equal(codes.read(0, 5), fixed_clip(settings)[0].read(0, 5))
    moved = np.abs(photons[1][:, 2:] - photons[0][:, :-2]).mean()
    assert moved < 0.2 * np.abs(photons[1] - photons[0]).mean()  # 2 px per frame, but for the disk that wraps around


def test_only_cases_that_differ_are_run():
    cases = cases_of(("moment:3", "unet", "mergenet", "quiver-s"), ("exact", "streaming"), ("float32", "bfloat16"))
    assert [c for c in cases if c.method == "moment:3"] == [CostCase("moment:3", "exact", "float32")]
    for network in ("unet", "mergenet"):  # the weights that ship have one mode, too
        assert [c.mode for c in cases if c.method == network] == ["exact", "exact"]
    assert len([c for c in cases if c.method == "quiver-s"]) == 4


def test_no_case_has_a_mode_or_precision_that_it_does_not_use():
    """The table named bfloat16 and streaming beside methods that have neither."""
    cases = cases_of(("moment", "unet", "quiver-s"), ("streaming",), ("bfloat16",))
    assert [(case.mode, case.precision) for case in cases] == [
        *(("exact", "float32"), ("exact", "bfloat16"), ("streaming", "bfloat16"))
    ]


def test_weights_of_a_folder_have_the_modes_of_their_network(tmp_path):
    for name, network in (("u", UNet(UNetConfig(2))), ("q", QUIVER(SMALL))):
        (tmp_path / name).mkdir()
        save(network, network.config, tmp_path / name / "best.safetensors")
    unet = str(tmp_path / "u")
    quiver = str(tmp_path / "q")
    cases = checked_cases((unet, quiver, "moment"), None, None, "cpu")
    assert [(case.method, case.mode) for case in cases] == [
        *((unet, "exact"), (quiver, "exact"), (quiver, "streaming"), ("moment", "exact"))
    ]
    with pytest.raises(ValueError, match=r"modes=: acts on QUIVER, .*/u has one mode; leave it out"):
        checked_cases((unet,), ("streaming",), None, "cpu")


def test_every_preset_is_a_case():
    assert {case.method for case in checked_cases(NETWORKS, None, None, None)} == {*NETWORKS}
    with pytest.raises(ValueError, match=r"no method 'fastdvd'.* and in `quiver bench` its presets"):
        checked_cases(("fastdvd",), None, None, None)
    cost = measure(CostCase("emvd-as-published"), CostSettings(16, 16, frames=5, restored=3))
    assert not cost.trained
    assert cost.gmac_per_frame > 0


def test_a_classical_case_has_seconds_and_a_score():
    started = time.perf_counter()
    cost = measure(CostCase("moment:3"), CostSettings(16, 16, frames=5, restored=3))
    assert cost.trained
    assert 0 < 3 * cost.seconds_per_frame < time.perf_counter() - started
    assert cost.psnr_matched > 10
    assert math.isnan(cost.gmac_per_frame)


@pytest.mark.parametrize(("together", "long", "runs"), [(1, 0.0, [2, 16]), (4, 10.0, [4, 4]), (4, 0.0, [4])])
def test_a_long_part_is_run_once(together, long, runs, monkeypatch):
    done = []

    def fill(codes, out, first, progress):
        done.append(len(out))
        out += codes.read(first, first + len(out))

    method = Restorer("n", 1, 0, False, "", fill, together=together)
    monkeypatch.setattr(costs, "method_of", lambda case, device: (method, True))
    monkeypatch.setattr(costs, "LONG", long)
    cost = measure(CostCase("n"), CostSettings(16, 16))
    assert done == runs
    assert 0 < cost.seconds_per_frame < 1


def test_the_table_names_what_failed():
    bad = CostRow("mergenet", "exact", "float32", False, math.nan, 0, math.nan, math.nan, failure="out of memory")
    assert "| mergenet | exact | float32 | failed: out of memory" in markdown([bad], CostSettings())


def test_a_bench_states_the_device_that_was_used(monkeypatch, capsys):
    monkeypatch.setattr(costs, "bench", lambda cases, settings, progress: [])
    assert main(["bench", "--methods", "moment", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["setting"]["device"] == "cpu"
    for there, kind in ((True, "cuda"), (False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert device_of([CostCase("moment:3"), CostCase("unet")], None) == kind
        assert device_of([CostCase("moment:3")], None) == kind
        assert device_of([CostCase("unet")], "cpu") == "cpu"


class InThisProcess:
    """Stands for a spawned process: it runs at once, here."""

    exitcode = 0

    def __init__(self, target, args, daemon: bool):
        self.start = lambda: target(*args)

    def join(self) -> None:
        """Do nothing: it has ended."""


def test_a_warning_of_a_case_names_the_method_and_not_a_place_in_the_source(monkeypatch):
    """Its process printed it with a path; here it is the command's, which prints one line."""

    def told(case: CostCase, settings: CostSettings) -> CostRow:
        for _ in range(2):
            warnings.warn("2000 MB hold no frame; it is cut", stacklevel=1)
        raise ValueError("no light")

    context = SimpleNamespace(Pipe=multiprocessing.Pipe, Process=InThisProcess)
    monkeypatch.setattr(costs.multiprocessing, "get_context", lambda kind: context)
    monkeypatch.setattr(costs, "measure", told)
    with pytest.warns(UserWarning, match=r"^unet: 2000 MB hold no frame; it is cut$") as found:
        rows = costs.bench([CostCase("unet", "exact", "float32")], CostSettings(16, 16))
    assert len(found) == 1
    assert rows[0].failure == "ValueError: no light"
