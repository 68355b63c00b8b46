"""Kinds of devices are named in one file of each package; networks and tensors are moved there by one function."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PLACES = {"qsim": "qsim/backend.py", "quiver": "quiver/device.py", "scenes": None}
USER_WORDS = {"--cuda"}  # an option of other programs, for which ours is suggested


def named(text: str) -> Iterator[int]:
    """Lines that name a kind of GPU: `torch.cuda`, `.cuda()`, `.pin_memory()`, "cuda" as a value; prose is free."""
    tree = ast.parse(text)
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        attribute = isinstance(node, ast.Attribute) and node.attr in ("cuda", "nccl", "pin_memory")
        value = isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose
        if attribute or (value and node.value not in USER_WORDS and re.search(r"\b(cuda|nccl)\b", node.value)):
            yield node.lineno


def test_devices_are_named_in_one_place_of_each_package():
    found = {}
    for package, place in PLACES.items():
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            lines = list(named(path.read_text(encoding="utf-8")))
            if name == place:
                assert lines
            elif lines:
                found[name] = lines
    assert not found, "ask qsim.backend or quiver.device"


def test_the_search_sees_calls_attributes_and_values():
    assert sorted(named('model.cuda()\nif torch.cuda.is_available():\n    x = "cuda:0"\n')) == [1, 2, 3]
    assert list(named('"""Runs on cuda."""\n\n\ndef f():\n    "Also drjit.cuda."\n')) == []
    assert list(named('d = {"--cuda": 1, "cuda_rng": 2}\n')) == []
