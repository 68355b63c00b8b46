"""What is in front of the camera: bodies, materials, lights and motions as frozen records, without a renderer."""

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from qsim.optics.camera import Camera
    from qsim.scene.scene import Body, Scene

__all__ = ["Body", "Camera", "Scene"]

__getattr__ = lazy_names(
    __name__,
    {
        "Body": "scene",
        "Camera": "scene",
        "Scene": "scene",
    },
)
