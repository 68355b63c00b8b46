"""Losses of the compared networks: which frames they compare, and in which precision."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from runs import tiny
from torch import Tensor

from quiver.training import rival_losses
from quiver.training.settings import PROTOCOLS
from quiver.training.systems import SYSTEMS


@pytest.mark.parametrize("count", [11, 12, 15, 16])
@pytest.mark.parametrize("share", [0.0, 0.4, 0.8])
def test_teachers_and_student_learn_the_middle_frame_of_any_window(count, share):
    """The middle is what the noisy copies rest as; a part that restores it exactly has no loss."""
    light = torch.arange(count, dtype=torch.float32).view(1, count, 1, 1, 1).expand(1, count, 1, 8, 8) / count
    middle = count // 2
    still = light[:, middle : middle + 1].expand(1, count, 1, 8, 8)

    def part(seen: Tensor) -> SimpleNamespace:
        assert seen.shape == (1, 11, 8, 8)
        return SimpleNamespace(restored=seen[:, 5:6], features=(seen, seen))

    network = SimpleNamespace(
        config=SimpleNamespace(distil=share < 0.6), motion_teacher=part, noise_teacher=part, student=part
    )
    batch = {"codes": light, "target": light, "still": still}
    assert rival_losses.student_teacher_loss(network, batch, None, share) == 0


def test_the_transforms_of_emvd_are_compared_in_float32_under_autocast(monkeypatch):
    kinds = []
    monkeypatch.setattr(
        rival_losses, "_from_identity", lambda product: kinds.append(product.dtype) or product.new_zeros(())
    )
    network = tiny("emvd")
    frames = torch.rand(1, 3, 1, 16, 16)
    with torch.autocast("cpu", torch.bfloat16):
        rival_losses.emvd_loss(network, {"codes": frames, "target": frames}, None, 0.0)
    assert kinds == [torch.float32] * 2


def test_published_protocols_train_in_float32():
    """Otherwise a GPU would take bfloat16, which no published program does."""
    found = {name: PROTOCOLS[name] for name in ("published", "paper")}
    found |= {
        system.name: system.protocols["published"] for system in SYSTEMS.values() if "published" in system.protocols
    }
    assert len(found) > 8
    assert {name for name, values in found.items() if values.get("precision") != "float32"} == set()
