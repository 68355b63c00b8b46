"""Provenance: the pictures, meshes and photographs of a scene."""

import small_scenes

from qsim.dataset import provenance
from qsim.scene import Body, Diffuse, textures


def test_assets_of_a_scene():
    described = {
        "kind": "Scene",
        "bodies": [
            {
                "kind": "Body",
                "mesh": {"kind": "Mesh", "vertices": {"sha256": "m"}},
                "material": {"kind": "Diffuse", "reflectance": {"kind": "Texture", "image": {"sha256": "t"}}},
            }
        ],
        "lights": [{"kind": "EnvironmentImage", "image": "sky.hdr"}],
    }
    assert provenance.assets(described) == ["mesh m", "texture sky.hdr", "texture t"]


def test_a_photograph_in_another_range_is_the_same_photograph():
    """One photograph in two ranges has two checksums: splits that share it must still be found."""
    made = []
    for high in (0.45, 0.7):
        material = Diffuse(textures.photograph("gravel", 0.15, high))
        made.append(small_scenes.scene(Body("plate", small_scenes.square(), material)))
    first, second = (set(provenance.assets(scene.to_dict())) for scene in made)
    assert first
    assert not first & second
    assert [provenance.photographs(scene) for scene in made] == [["photograph gravel"], ["photograph gravel"]]
