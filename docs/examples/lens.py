"""
# A real lens, and the path of its camera

A camera may have a thin lens instead of a pinhole, radial distortion, and corners that are darker than the middle. All
of it has a closed form, and flow, depth and bodies follow the distorted rays.
"""

# %%
# **Depth of field.** Small glowing squares stand at seven depths. The lens is focused on the fourth; every other one
# spreads over its circle of confusion.

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import qsim
import qsim.cli
from qsim.optics import Camera, Lens
from qsim.rendering import Budget, Renderer
from qsim.scene import Body, Constant, Diffuse, Glow, Oscillation, Scene, Spin, Still, Texture, textures
from qsim.scene.camera_path import read_camera_path
from qsim.scene.shapes import sheet

side, samples, frames = 96, 1024, 12  # tests: 48, 64, 4
camera = Camera(25e-3, 1.4, 5e-5 * 96 / side, side, 7 * side, origin=(0, 0, 0), target=(0, 0, -1), aperture_blur=True)
camera = replace(camera, focus_distance=0.5)
depths = 0.5 * np.geomspace(0.6, 1.8, 7)
depths[3] = 0.5
spots = []
for i, depth in enumerate(depths):
    across = (i - 3) * side / camera.focal_pixels * depth
    spots.append(Body(f"spot {i}", sheet(0.02 * depth, 0.02 * depth), Glow(1.0), Still((across, 0.0, -depth))))
picture = (
    Renderer(Scene("spots", 0, camera, (Constant(0.0),), tuple(spots)), budget=Budget(samples, 1)).frame(0).radiance
)

# %%
# A disk of diameter c adds the variance c²/16 to that of the square and of the pixel, so its width can be measured.
# In focus the noise of the variance is left.

x = np.arange(side) + 0.5
own = 0.02 * camera.focal_pixels  # px, side of the squares
found = []
for i in range(7):
    light = picture[:, i * side : (i + 1) * side].sum(axis=0).astype(float)
    middle = np.average(x, weights=light)
    variance = np.average((x - middle) ** 2, weights=light) - own**2 / 12 - 1 / 12
    found.append(4 * np.sqrt(max(variance, 0.0)))
figure, (left, right) = plt.subplots(2, 1, figsize=(7, 4), layout="constrained", height_ratios=(1, 1.6))
left.imshow(picture**0.4, cmap="gray")
left.axis("off")
fine = np.linspace(depths[0], depths[-1], 200)
right.plot(fine, camera.circle_of_confusion(fine), label="A f |z - s| / (z (s - f))")
right.plot(depths, found, "o", label="measured in the picture")
right.set(xlabel="depth [m]", ylabel="blur [px]")
right.legend()
for depth, width in zip(depths, found, strict=True):
    print(f"{depth:.3f} m: {width:5.2f} px, by the law {float(camera.circle_of_confusion(depth)):5.2f} px")

# %%
# **Distortion and fall-off.** A chequered wall before a camera that turns and sways, as an ideal lens shows it and
# through one with barrel distortion and dark corners. Each distorted ray is traced; nothing is resampled. Photons fall
# off by the lens, radiance does not.

motion = Spin((0, 0.3, 1), 20.0) @ Oscillation((0.01, 0.004, 0.0), 120.0)
view = Camera(3e-3, 2.8, 3e-3 / side, side, 2 * side, origin=(0, 0, 1), motion=motion)
wall = Body("wall", sheet(9, 9), Diffuse(Texture(textures.checker(2, 2, 0.2, 0.8), repeat=(9, 9))))
ideal = Scene("wall", 0, view, (Constant(1.0),), (wall,))
bent = replace(ideal, camera=replace(view, lens=Lens(k1=-0.12, k2=0.01, falloff=(-0.25,))))
figure, axes = plt.subplots(1, 3, figsize=(9, 1.9), layout="constrained")
for axis, scene, name in zip(axes, (ideal, bent), ("ideal", "k1 = -0.12, falloff -0.25"), strict=False):
    frame = Renderer(scene, budget=Budget(36, 1)).frame(8)
    photons = qsim.expected_photons(frame.radiance, scene.camera, 5e-4)
    axis.imshow(photons, cmap="gray", vmax=float(np.percentile(photons, 99)))
    axis.set_title(name, fontsize=9)
    axis.axis("off")
speed = np.hypot(*frame.flow)
shown = axes[2].imshow(speed, vmax=float(np.percentile(speed, 99)))
axes[2].set_title("flow [px/frame]", fontsize=9)
axes[2].axis("off")
figure.colorbar(shown, ax=axes[2])

# %%
# The flow is that of the distorted camera: the points behind all pixels, projected by the camera of the next frame.

rays = bent.camera.directions() @ bent.camera.pose(8 / 2000)[:3, :3].T
points = bent.camera.pose(8 / 2000)[:3, 3] + rays * frame.depth[..., None]
y, x = np.mgrid[:side, : 2 * side] + 0.5
ends, _ = bent.camera.project(points, 9 / 2000)
difference = np.abs(np.stack([ends[..., 0] - x, ends[..., 1] - y]) - frame.flow).max()
print("flow differs from the projection by less than 0.001 px:", bool(difference < 1e-3))

# %%
# **The camera path.** A clip stores the pose of every frame, and `qsim convert` writes them as the transforms.json of
# nerfstudio, beside the pictures. `read_camera_path` makes a camera of such a file, of any program.

clip = qsim.render(bent, "clip", frames=frames, height=side // 2, width=side, budget=Budget(36, 1))
qsim.cli.main(["convert", "clip", "poses", "--to", "nerfstudio"])
path = read_camera_path("poses/transforms.json")
worst = max(np.abs(path.pose(t / 2000) - pose).max() for t, pose in enumerate(clip.info.poses))
print("poses come back within 1e-9:", bool(worst < 1e-9))
places = np.array([path.pose(t)[:3, 3] for t in np.linspace(0, (frames - 1) / 2000, 80)])
figure, (left, right) = plt.subplots(1, 2, figsize=(7, 2.4), layout="constrained")
left.imshow(clip[frames // 2], cmap="gray")
left.axis("off")
right.plot(1e3 * places[:, 0], 1e3 * places[:, 1], label="between the poses")
right.plot(*(1e3 * np.array(clip.info.poses)[:, :2, 3].T), "o", label="frames")
right.set(xlabel="x [mm]", ylabel="y [mm]")
right.legend()
