"""Records the origin of a clip: its job, and the pictures, meshes and photographs of its scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from qsim.clip.clip_info import Origin, SceneName
from qsim.dataset.job import Job

_ASSETS = {  # kind of a scene's record -> the key of its array or file, and the kind of asset
    "Texture": ("image", "texture"),
    "Picture": ("colours", "texture"),
    "NormalMap": ("image", "texture"),
    "EnvironmentImage": ("image", "texture"),
    "Mesh": ("vertices", "mesh"),
}


def origin(job: Job, read: dict[str, str] | None = None) -> Origin:
    """Return what a job states in clip.json: its digest, its scene and split.

    `read` maps the user's files that the scene reads to their SHA-256 (scene_files.py).
    """
    scene = SceneName(family=job.stem, seed=job.scene_seed, speed=job.speed)
    return Origin(job=job.digest, split=job.split, scene=scene, reads=read or {})


def nested(value: Any) -> Iterator[Any]:
    """Yield a value and everything inside it: items of lists and tuples, values of dicts, fields of records."""
    waiting = [value]
    while waiting:
        item = waiting.pop()
        yield item
        if isinstance(item, list | tuple):
            waiting += item
        elif isinstance(item, dict):
            waiting += item.values()
        elif dataclasses.is_dataclass(item):
            waiting += [getattr(item, part.name) for part in dataclasses.fields(item)]


def assets(described: Any) -> list[str]:
    """Return the pictures and meshes of a described scene: `texture SHA-256`, `texture FILE` or `mesh SHA-256`."""
    found: set[str] = set()
    for item in nested(described):
        if isinstance(item, dict):
            key, kind = _ASSETS.get(str(item.get("kind")), ("", ""))
            value = item.get(key)
            if isinstance(value, dict) and "sha256" in value:
                found.add(f"{kind} {value['sha256']}")
            elif isinstance(value, str):
                found.add(f"{kind} {value}")
    return sorted(found)


def photographs(scene: Any) -> list[str]:
    """Return `photograph NAME` for every texture of a scene that states its source, at any range of values."""
    from qsim.scene import Texture

    sources = {item.source for item in nested(scene) if isinstance(item, Texture)}
    return sorted(f"photograph {name}" for name in sources if name is not None)
