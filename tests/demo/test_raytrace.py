"""The ray tracer and its light in configurations with a known result."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike

from clod_adapter.cameras import Camera
from clod_adapter.demo.lightmaps import bounced_light, lamp_light, light_texels, with_mirrors
from clod_adapter.demo.raytrace import Tables, decode_srgb, encode_srgb, render_linear, trace_rays
from clod_adapter.demo.shapes import Finish, SceneBuilder

WHITE = np.ones((2, 2, 3), np.float32)


def camera(side: int, focal: float) -> Camera:
    """At the origin, looking along +z, upright in a world with y down."""
    K = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    return Camera(torch.eye(4), K, side, side)


def wall(texture: np.ndarray, size: float = 1.0, far: float = 10.0, tile: float | None = None) -> SceneBuilder:
    scene = SceneBuilder({"wall": texture, "white": WHITE})
    scene.panel((0, 0, far), (0, 0, 1), (size, size), Finish("wall", tile=tile))
    return scene


def shoot(tables: Tables, origins: ArrayLike, directions: ArrayLike) -> np.ndarray:
    starts, ways = np.array(origins, float), np.array(directions, float)
    out = np.empty((len(starts), 4))
    trace_rays(tables, starts, ways, 1e-3, out)
    return out


def test_texture_is_upright_and_area_averaged() -> None:
    """A camera facing a wall sees the texture unmirrored; larger pixels are averages over their area."""
    texture = np.random.default_rng(0).random((64, 64, 3), np.float32)
    scene = wall(texture).tables()
    np.testing.assert_allclose(render_linear(scene, camera(64, 640.0), samples=1), texture, atol=0.01)
    want = texture.reshape(16, 4, 16, 4, 3).mean((1, 3))
    # Texels are interpolated, so the border of a pixel also has its neighbours' colours.
    assert np.abs(render_linear(scene, camera(16, 160.0), samples=4) - want).mean() < 0.03


def test_a_distant_fine_pattern_is_grey() -> None:
    board = np.kron(np.indices((32, 32)).sum(0) % 2, np.ones((2, 2)))[..., None].repeat(3, 2).astype(np.float32)
    seen = render_linear(wall(board, size=8.0, tile=1.0).tables(), camera(32, 41.0), samples=3)
    np.testing.assert_allclose(seen[2:-2, 2:-2], 0.5, atol=0.02)


def test_distances_and_colours_are_exact() -> None:
    scene = SceneBuilder({"white": WHITE})
    scene.ball((0, 0, 5), 2.0, Finish("white"))
    scene.column((10, 0, 5), 1.0, 2.0, Finish("white"), Finish("white"))
    scene.box((20, 0, 5), (2, 2, 2), Finish("white"), turn=np.pi / 4)
    origins = np.array([[0, 0, 0], [10, -1, 0], [10.5, -5, 5], [10, -2.1, 0], [20, -1, 0], [20, -5, 5]])
    directions = np.array([[0, 0, 1], [0, 0, 1], [0, 1, 0], [0, 0, 1], [0, 0, 1], [0, 1, 0]])
    distance = shoot(scene.tables(), origins, directions)[:, 3]
    np.testing.assert_allclose(distance, [3, 4, 3, np.inf, 5 - np.sqrt(2), 3], atol=1e-9)
    scene = wall(WHITE)
    scene.panel((0, 0, 5), (0, 0, -1), (1, 1), Finish("white"))  # the back of a panel is black and opaque
    np.testing.assert_allclose(shoot(scene.tables(), [[0, 0, 0]], [[0, 0, 1]]), [[0, 0, 0, 5]])
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(encode_srgb(decode_srgb(codes)), codes)


def test_lamp_light_matches_its_form_factor() -> None:
    scene = SceneBuilder({"white": WHITE})
    scene.panel((0, 0, 0), (0, 1, 0), (2, 2), Finish("white"), down=(0, 0, 1))
    scene.panel((0, -1.5, 0), (0, -1, 0), (1.2, 0.8), Finish("white", glow=3.0), down=(0, 0, 1))
    out = np.empty((1, 3))
    lamp_light(scene.tables(), np.array([1]), np.array([0]), np.full((1, 2), 0.5), np.full((1, 2), 0.5), 40, out)
    a, b = 0.6 / 1.5, 0.4 / 1.5
    factor = 2 / np.pi * (
        a / np.sqrt(1 + a * a) * np.arctan(b / np.sqrt(1 + a * a))
        + b / np.sqrt(1 + b * b) * np.arctan(a / np.sqrt(1 + b * b))
    )  # fmt: skip
    np.testing.assert_allclose(out, 3.0 * factor, rtol=1e-3)


def test_bounced_light_of_a_closed_box_is_its_albedo() -> None:
    scene = SceneBuilder({"grey": WHITE * 0.6})
    for s in (-1, 1):
        for forward, down in (((s, 0, 0), (0, 1, 0)), ((0, s, 0), (0, 0, 1)), ((0, 0, s), (0, 1, 0))):
            scene.panel(forward, forward, (2, 2), Finish("grey", light_texel=0.5), down=down)
    tables = scene.tables()
    where, uv, jitter = light_texels(tables.surfaces)
    out = np.empty((len(where), 3))
    bounced_light(tables, where, uv, jitter, 4, out)
    np.testing.assert_allclose(out, 0.6, rtol=1e-6)


def test_only_glossy_surfaces_depend_on_the_view() -> None:
    scene = SceneBuilder({"white": WHITE, "red": WHITE * [1, 0, 0]})
    scene.ball((0, 0, 5), 1.0, Finish("white", gloss=0.5))
    scene.ball((9, 0, 5), 1.0, Finish("white"))
    scene.panel((-4, 0, 3), (-1, 0, 0), (9, 9), Finish("red"))
    tables = with_mirrors(scene.tables())
    front = np.array([[0, 0, 4.0], [0, 0, 4.0], [9, 0, 4.0], [9, 0, 4.0]])
    offsets = np.array([[3.0, 0, -1], [-3, 0, -1]] * 2) / np.sqrt(10)
    seen = shoot(tables, front + offsets, -offsets)[:, :3]
    assert np.abs(seen[0] - seen[1]).max() > 0.1
    np.testing.assert_allclose(seen[2], seen[3])
