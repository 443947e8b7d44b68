"""The demo scene: a ray-traced gallery of framed photographs and solids, written as a COLMAP capture.

World axes: x right, y DOWN, z into the room, in metres; so upright photographs have the usual COLMAP orientation. The
room is 6 m wide (x from -3 to 3), 8 m long (z from 0 to 8) and 3 m high (floor at y = 0, ceiling at y = -3).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import gallery_textures as tx
from clod_adapter.cameras import Camera
from clod_adapter.io.scene.colmap import write_model
from gallery_lightmaps import bake_light
from gallery_paths import path_cameras
from gallery_raytrace import Tables, camera_rays, encode_srgb, render_linear, trace_rays
from gallery_shapes import Finish, SceneBuilder

import numpy as np
from PIL import Image

LOW, HIGH = np.array([-3.0, -3.0, 0.0]), np.array([3.0, 0.0, 8.0])
WIDTH, HEIGHT, VIEWS = 480, 360, 80
CANDIDATES = 4  # pixels sampled per point; those with detail are preferred
HOLD_OUT = 8  # every 8th view by name is held out
OAK, BLACK, WHITE, GOLD = (122, 84, 52), (34, 32, 32), (226, 222, 214), (168, 128, 66)

# name, wall, metres along the wall, height of the centre, width and height in metres, frame
PICTURES = (
    ("astronaut.png", "left", 1.6, 1.6, (1.1, 1.3), OAK),
    ("coffee.png", "left", 3.7, 1.6, (1.5, 1.1), BLACK),
    ("chelsea.png", "left", 6.0, 1.6, (1.5, 1.1), GOLD),
    ("coins.png", "right", 1.8, 1.6, (1.6, 1.25), BLACK),
    ("retina.jpg", "right", 4.0, 1.6, (1.2, 1.2), OAK),
    ("rocket.jpg", "right", 6.2, 1.6, (1.5, 1.1), WHITE),
    ("hubble_deep_field.jpg", "end", 0.0, 1.65, (2.3, 1.8), BLACK),
    ("ihc.png", "start", -1.3, 1.6, (1.2, 1.2), BLACK),
    ("camera.png", "start", 1.3, 1.6, (1.2, 1.2), OAK),
)


@dataclass(frozen=True)
class Gallery:
    """The lit scene, made by `make_gallery`.

    Attributes:
        tables: the ray tracer's scene.
        samples: rays per pixel along x and along y.
    """

    tables: Tables
    samples: int = 3

    def render(self, camera: Camera) -> np.ndarray:
        """``[H, W, 3]`` uint8 sRGB, anti-aliased: the mean of linear light over each pixel's square."""
        return encode_srgb(render_linear(self.tables, camera, self.samples))

    def cameras(self) -> list[Camera]:
        """The views, along smooth paths, both far from and close to the surfaces.

        Held-out views (every 8th) lie between neighbours on their path.
        """
        return path_cameras(WIDTH, HEIGHT, VIEWS)

    def sample_points(self, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """A point cloud like that of structure from motion, from rays of the training cameras.

        Args:
            n: number of points; denser on near surfaces and on detail, like feature matches.
            seed: of pixel selection and noise.

        Returns:
            points ``[n, 3]`` float32 metres, with noise of about 0.3 % of their distance, and colours ``[n, 3]`` uint8
            sRGB.
        """
        random = np.random.default_rng(seed)
        cameras = [camera for k, camera in enumerate(self.cameras()) if k % HOLD_OUT]
        points, colors = [], []
        for camera, share in zip(cameras, np.array_split(np.arange(n), len(cameras)), strict=True):
            pixels = random.random((CANDIDATES * len(share), 2)) * [camera.width, camera.height]
            seen, directions = self._look(camera, pixels)
            shades = [encode_srgb(seen[:, :3]).astype(float)]
            shades += [encode_srgb(self._look(camera, pixels + step)[0][:, :3]) for step in ([1, 0], [0, 1])]
            detail = abs(shades[1] - shades[0]).sum(1) + abs(shades[2] - shades[0]).sum(1)
            detail += 0.2 * detail.mean() + 1e-3
            chosen = random.choice(len(pixels), len(share), replace=False, p=detail / detail.sum())
            noise = random.normal(0, 0.003 / np.sqrt(3), (len(share), 3))
            eye = camera.position.numpy().astype(float)
            points.append(eye + seen[chosen, 3:] * (directions[chosen] + noise))
            colors.append(shades[0][chosen].astype(np.uint8))
        return np.concatenate(points).astype(np.float32), np.concatenate(colors)

    def _look(self, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Linear colour and distance ``[n, 4]`` along rays through ``pixels [n, 2]``, and the rays' directions."""
        eye, rays = camera_rays(camera)
        directions = np.column_stack([pixels, np.ones(len(pixels))]) @ rays.T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        seen = np.empty((len(pixels), 4))
        trace_rays(self.tables, np.tile(eye, (len(pixels), 1)), directions, 1 / float(camera.K[0, 0]), seen)
        return seen, directions


def make_gallery() -> Gallery:
    """Builds the room and bakes its light, which takes several seconds."""
    return Gallery(bake_light(unlit_room()))


def unlit_room() -> Tables:
    """The room without light: every surface has the colours of its texture."""
    scene = SceneBuilder(materials())
    add_room(scene)
    add_pictures(scene)
    add_solids(scene)
    return scene.tables()


def materials() -> dict[str, np.ndarray]:
    """All textures of the scene by name; pictures have the names of their files."""
    pictures = {name: tx.framed(name, size, frame) for name, _, _, _, size, frame in PICTURES}
    return pictures | {
        "floor": tx.planks((108, 74, 46), (176, 132, 88)),
        "cream": tx.plaster((222, 212, 192), 0.025, seed=1),
        "blue": tx.plaster((84, 118, 132), 0.05, seed=2),
        "ceiling": tx.plain((236, 234, 228)),
        "bricks": tx.brickwork((124, 60, 44), (204, 158, 130)),
        "gravel": tx.toned(tx.photograph("gravel.png"), (70, 66, 62), (196, 188, 176)),
        "grass": tx.toned(tx.photograph("grass.png"), (28, 52, 20), (134, 166, 74)),
        "terrazzo": tx.toned(tx.photograph("gravel.png"), (136, 112, 104), (242, 234, 222)),
        "oak": tx.planks((120, 82, 48), (168, 122, 76), rows=5, seed=8),
        "chequers": tx.chequers(12, 6, (196, 62, 44), (240, 226, 196)),
        "coffee": tx.linear(tx.photograph("coffee.png").crop((100, 0, 500, 400))),
        "white": tx.plain((238, 236, 232)),
        "dark": tx.plain((46, 40, 36)),
        "enamel": tx.plain((20, 92, 112)),
    }


def add_room(scene: SceneBuilder) -> None:
    """Walls, floor, ceiling, skirting boards and three lamps under the ceiling."""
    cream, skirting = Finish("cream", tile=2.0, light_texel=0.07), Finish("dark")
    scene.panel((0, 0, 4), (0, 1, 0), (6, 8), Finish("floor", tile=1.6, light_texel=0.04), down=(0, 0, -1))
    scene.panel((0, -3, 4), (0, -1, 0), (6, 8), Finish("ceiling", light_texel=0.12), down=(0, 0, 1))
    scene.panel((-3, -1.5, 4), (-1, 0, 0), (8, 3), cream)
    scene.panel((3, -1.5, 4), (1, 0, 0), (8, 3), cream)
    scene.panel((0, -1.5, 8), (0, 0, 1), (6, 3), Finish("bricks", tile=1.8, light_texel=0.07))
    scene.panel((0, -1.5, 0), (0, 0, -1), (6, 3), Finish("blue", tile=2.0, light_texel=0.07))
    for x, turn in ((-2.985, -np.pi / 2), (2.985, np.pi / 2)):
        scene.box((x, 0, 4), (7.94, 0.12, 0.03), skirting, turn=turn, faces="front top")
    for z, turn in ((0.015, np.pi), (7.985, 0.0)):
        scene.box((0, 0, z), (6, 0.12, 0.03), skirting, turn=turn, faces="front top")
    for z in (1.5, 4.0, 6.5):
        scene.box((0, -2.94, z), (2.2, 0.06, 0.5), Finish("dark"), faces="front back left right")
        scene.panel((0, -2.945, z), (0, -1, 0), (2.19, 0.49), Finish("white", glow=21.0), down=(0, 0, 1))


def add_pictures(scene: SceneBuilder) -> None:
    """All pictures, as thin boxes on their walls."""
    depth = 0.05
    walls = {"left": -np.pi / 2, "right": np.pi / 2, "end": 0.0, "start": np.pi}
    for name, wall, along, middle, (width, height), _ in PICTURES:
        x = {"left": LOW[0] + depth / 2, "right": HIGH[0] - depth / 2}.get(wall, along)
        z = {"end": HIGH[2] - depth / 2, "start": LOW[2] + depth / 2}.get(wall, along)
        scene.box(
            (float(x), height / 2 - middle, float(z)), (width, height, depth), Finish("dark"), front=Finish(name),
            turn=walls[wall], faces="front left right top bottom",
        )  # fmt: skip


def add_solids(scene: SceneBuilder) -> None:
    """Objects on the floor: plinths with balls and a box, a brick column, a bench and a planter."""
    white, oak = Finish("white"), Finish("oak", tile=0.6, light_texel=0.03)
    scene.box((0, 0, 4), (0.56, 0.85, 0.56), white, turn=0.4)
    scene.ball((0, -1.12, 4), 0.27, Finish("enamel", gloss=0.12, light_texel=0.03))
    scene.column((-1.15, 0, 5.7), 0.28, 1.0, Finish("bricks", tile=0.7, light_texel=0.03), Finish("gravel", tile=0.4))
    scene.box((-1.15, -1.0, 5.7), (0.32, 0.32, 0.32), Finish("coffee", light_texel=0.02), turn=-0.5)
    scene.box((1.15, 0, 5.7), (0.5, 0.8, 0.5), white, turn=-0.3)
    scene.ball((1.15, -1.05, 5.7), 0.25, Finish("terrazzo", tile=0.55, light_texel=0.03))
    scene.box((-1.1, 0, 2.2), (0.9, 0.4, 0.5), oak, turn=0.25, top=Finish("grass", tile=0.5, light_texel=0.03))
    scene.ball((-1.1, -0.58, 2.2), 0.18, Finish("chequers", light_texel=0.02))
    scene.box((1.1, -0.38, 2.3), (0.45, 0.06, 1.3), oak, turn=-0.1, faces="front back left right top bottom")
    for z in (-0.45, 0.45):
        foot = (1.1 + z * np.sin(-0.1), 0.0, 2.3 + z * np.cos(-0.1))
        scene.box(foot, (0.35, 0.379, 0.06), Finish("dark"), turn=-0.1, faces="front back left right")


def write_capture(folder: Path, gallery: Gallery, quality: int) -> None:
    """Renders the views into a new `folder`: ``images/*.webp`` and a COLMAP model without points."""
    (folder / "images").mkdir(parents=True)
    cameras = gallery.cameras()
    for camera in cameras:
        picture = Image.fromarray(gallery.render(camera))
        picture.save(folder / "images" / camera.name, quality=quality, method=6)
    write_model(folder, cameras, [camera.name for camera in cameras])
