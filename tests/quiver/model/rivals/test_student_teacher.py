"""Student-Teacher has the specified sizes, and its loss pulls each encoder towards its own teacher."""

import json

import pytest
import torch
import torch.nn.functional as F
from golden import draw
from rivals import lively
from torch import Tensor

from quiver.model.rivals.edges import reflected
from quiver.model.rivals.student_teacher import (
    StudentTeacher,
    StudentTeacherConfig,
    Taught,
    distillation_loss,
    feature_distance,
)

SMALL = StudentTeacherConfig(width=3, blocks=1)


def described(state: dict[str, Tensor], frames: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The student of the description, one residual block per stage, layer by layer."""

    def layer(x: Tensor, place: str, stride: int = 1) -> Tensor:
        return F.conv2d(x, state[f"student.{place}.weight"], state[f"student.{place}.bias"], stride, padding=1)

    def block(x: Tensor, place: str) -> Tensor:
        return x + layer(layer(x, f"{place}.first").clamp(min=0), f"{place}.second")

    full = [block(layer(frames, f"{name}.full.0").clamp(min=0), f"{name}.full.2") for name in ("motion", "noise")]
    half = [
        block(layer(x, f"{name}.down.0", 2).clamp(min=0), f"{name}.down.2")
        for name, x in zip(("motion", "noise"), full, strict=True)
    ]
    up = block(layer(torch.cat(half, dim=1), "decoder.up.0").clamp(min=0), "decoder.up.2")
    up = F.pixel_shuffle(layer(up, "decoder.up.3"), 2)
    x = block(layer(torch.cat([up, *full], dim=1), "decoder.leave.0").clamp(min=0), "decoder.leave.2")
    return layer(x, "decoder.leave.3") + frames[:, 5:6], half


def test_the_student_equals_the_description():
    network = lively(StudentTeacher(SMALL))
    frames = draw(2, 11, 10, 8)
    with torch.no_grad():
        wanted, half = described(network.state_dict(), frames)
        found = network.student(frames)
    assert (found.restored - wanted).abs().max() < 1e-12
    assert all((a - b).abs().max() < 1e-12 for a, b in zip(found.features, half, strict=True))


def test_the_networks_have_the_specified_parameters():
    network = StudentTeacher()
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in network.named_children()}
    assert counts == {"student": 2_191_937, "motion_teacher": 1_484_033, "noise_teacher": 1_484_033}
    assert sum(p.numel() for p in network.student.motion.parameters()) == 634_176
    alone = StudentTeacher(StudentTeacherConfig(distil=False))
    assert sum(p.numel() for p in alone.parameters()) == 2_191_937


def test_a_clip_is_restored_window_by_window_without_the_teachers():
    network = lively(StudentTeacher(SMALL))
    frames = draw(1, 4, 1, 8, 10)
    order = reflected(-5, 14, 4)
    for teacher in (network.motion_teacher, network.noise_teacher):
        teacher.register_forward_hook(lambda *_: pytest.fail("a teacher was called"))
    with torch.no_grad():
        restored = network(frames)
        alone = torch.cat([network.windows(frames[:, order[t : t + 11]]) for t in range(4)], dim=1)
    assert torch.equal(restored, alone)


def test_features_are_compared_without_their_scale_and_mean():
    a = draw(2, 3, 5, 4)
    b = draw(2, 3, 5, 4, seed=1)
    scale = draw(2, 3, 1, 1, seed=2) + 0.5
    shift = draw(2, 3, 1, 1, seed=3)
    assert float(feature_distance(a, scale * a + shift)) < 1e-5
    assert float(feature_distance(a, -a)) == pytest.approx(4, rel=1e-4)
    assert float(feature_distance(a, scale * b - shift)) == pytest.approx(float(feature_distance(a, b)), rel=1e-4)
    correlation = torch.stack(
        [
            torch.corrcoef(torch.stack([x.flatten(), y.flatten()]))[0, 1]
            for x, y in zip(a.flatten(0, 1), b.flatten(0, 1), strict=True)
        ]
    )
    assert float(feature_distance(a, b)) == pytest.approx(float(2 - 2 * correlation.mean()), rel=1e-4)


def test_constant_features_have_a_finite_slope():
    constant = torch.ones(1, 2, 3, 3, requires_grad=True)
    distance = feature_distance(constant, draw(1, 2, 3, 3, dtype=torch.float32))
    distance.backward()
    assert distance.isfinite()
    assert constant.grad.isfinite().all()


def test_the_loss_is_the_error_and_the_weighted_distances():
    restored = draw(2, 1, 6, 6)
    target = draw(2, 1, 6, 6, seed=1)
    own, motion, noise = (draw(2, 3, 3, 3, seed=seed) for seed in (2, 3, 4))
    student = Taught(restored, (own, 2 * own))
    error = float((restored - target).square().mean())
    apart = [float(feature_distance(own, teacher)) for teacher in (motion, noise)]
    for weights in ((0.0, 0.0), (0.3, 0.0), (0.0, 0.7)):
        wanted = error + weights[0] * apart[0] + weights[1] * apart[1]
        assert float(distillation_loss(student, target, motion, noise, weights)) == pytest.approx(wanted, rel=1e-5)
    standard = error + 0.1 * sum(apart)
    assert float(distillation_loss(student, target, motion, noise)) == pytest.approx(standard, rel=1e-5)


def test_each_teacher_leads_its_own_encoder():
    """Gradients of one distance reach one encoder of the student, and no teacher."""
    network = lively(StudentTeacher(SMALL))
    frames = draw(1, 11, 8, 8)
    with torch.no_grad():
        motion = network.motion_teacher(draw(1, 11, 8, 8, seed=1)).features[0]
        noise = network.noise_teacher(draw(1, 11, 8, 8, seed=2)).features[0]
    for weights, led, left in (((1.0, 0.0), "motion", "noise"), ((0.0, 1.0), "noise", "motion")):
        network.zero_grad()
        student = network.student(frames)
        alone = student._replace(restored=student.restored.detach())
        distillation_loss(alone, frames[:, 5:6], motion, noise, weights).backward()
        encoders = {name: getattr(network.student, name).full[0].weight.grad for name in ("motion", "noise")}
        assert encoders[led].abs().max() > 0
        assert encoders[left].abs().max() == 0
        assert network.motion_teacher.encoder.full[0].weight.grad is None


def test_a_teacher_cannot_copy_its_input():
    """Without weights in its last layer a teacher gives nothing: it adds no frame."""
    teacher = lively(StudentTeacher(SMALL)).motion_teacher
    frames = draw(1, 11, 8, 8)
    for parameter in teacher.decoder.leave[-1].parameters():
        torch.nn.init.zeros_(parameter)
    assert not teacher(frames).restored.any()


def test_a_configuration_survives_json():
    config = StudentTeacherConfig(width=24, blocks=2, distil=False)
    assert StudentTeacherConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 0, "StudentTeacherConfig.width must be a whole number from 1"),
        ("blocks", -1, "StudentTeacherConfig.blocks must be a whole number from 0"),
        ("distil", 1, "StudentTeacherConfig.distil must be true or false"),
    ],
)
def test_configurations_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        StudentTeacherConfig(**{field: value})
