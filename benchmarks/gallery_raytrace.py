"""A small ray tracer: textured quads, discs, spheres and upright cylinders with light maps.

A ray's colour is ``albedo * light`` (or ``albedo * glow`` for a lamp), where ``light`` is looked up in the surface's
light map, so the shading of a matt surface does not depend on the camera. A glossy surface adds a
prefiltered environment map, looked up in the mirror direction. World axes are those of the scene with
y pointing down; distances are in world units; colours are linear RGB until `encode_srgb`.
"""

from __future__ import annotations

import os
from collections import deque
from functools import partial
from math import floor, log2, sqrt
from typing import Any, NamedTuple

from clod_adapter._support.workers import in_order
from clod_adapter.cameras import Camera
from gallery_intersect import compiled, nearest, record, sphere_uv, surface_point

import numpy as np

MIRROR_HEIGHT = 24  # rows of a glossy surface's environment map; it is twice as wide
ROWS = 16  # image rows per task: small enough to balance the cores
LEVEL = record("first height width", "")  # one level of a texture's mip chain in `Tables.texels`


class Tables(NamedTuple):
    """The scene as arrays, which compiled code unpacks in this order.

    Besides its geometry, the row of a surface has:

    - `level`, the index of its texture's finest level, `levels`, their number, and `texel`, the world size of a
      texel of the finest;
    - `repeat_u`, `repeat_v`, the repetitions of the texture along u and v, every second one mirrored;
    - `light`, the first row of its light map in the array of that name, and the height and width of the map;
    - `glow`, the radiance of a lamp as a factor of its albedo, 0 for other surfaces;
    - `gloss`, the reflectance at normal incidence, and `mirror`, the first row of its environment map in `light`, -1
      for a matt surface.
    """

    surfaces: np.ndarray  # [P] of SURFACE
    groups: np.ndarray  # [G] of GROUP
    levels: np.ndarray  # [*] of LEVEL
    texels: np.ndarray  # [*, 3] float32 linear albedo
    light: np.ndarray  # [*, 3] float32 irradiance / pi, then the mirrors' radiance


@compiled
def bilinear(pixels: np.ndarray, first: int, height: int, width: int, u: float, v: float) -> Any:
    """Interpolated r, g, b of a ``height x width`` image that starts at row `first` of `pixels`; edges clamp."""
    x = min(max(u * width - 0.5, 0.0), width - 1.0)
    y = min(max(v * height - 0.5, 0.0), height - 1.0)
    x0, y0 = int(x), int(y)
    fx, fy = x - x0, y - y0
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    p, q, r, s = first + y0 * width + x0, first + y0 * width + x1, first + y1 * width + x0, first + y1 * width + x1
    wp, wq, wr, ws = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    return (
        wp * pixels[p, 0] + wq * pixels[q, 0] + wr * pixels[r, 0] + ws * pixels[s, 0],
        wp * pixels[p, 1] + wq * pixels[q, 1] + wr * pixels[r, 1] + ws * pixels[s, 1],
        wp * pixels[p, 2] + wq * pixels[q, 2] + wr * pixels[r, 2] + ws * pixels[s, 2],
    )


@compiled
def mirrored(x: float) -> float:
    """x folded into 0..1, so that photographs repeat without seams."""
    x = x - 2 * floor(x / 2)
    return 2 - x if x > 1 else x


@compiled
def albedo(s: Any, levels: np.ndarray, texels: np.ndarray, u: float, v: float, footprint: float) -> Any:
    """Trilinear (mip-mapped) texture of a surface, for a ray of width `footprint` (world units) at the hit."""
    u, v = mirrored(u * s.repeat_u), mirrored(v * s.repeat_v)
    depth = min(log2(max(footprint / s.texel, 1.0)), s.levels - 1.0)
    k = int(depth)
    blend = depth - k
    level = levels[s.level + k]
    r, g, b = bilinear(texels, level.first, level.height, level.width, u, v)
    if blend > 0:
        level = levels[s.level + k + 1]
        r2, g2, b2 = bilinear(texels, level.first, level.height, level.width, u, v)
        r, g, b = r + blend * (r2 - r), g + blend * (g2 - g), b + blend * (b2 - b)
    return r, g, b


@compiled
def radiance(
    surfaces: np.ndarray, groups: np.ndarray, levels: np.ndarray, texels: np.ndarray, light: np.ndarray,
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, spread: float,
) -> Any:  # fmt: skip
    """Radiance along a ray: r, g, b and the distance (black and inf outside the scene).

    `spread` is the ray's width per unit of distance. The back of a flat surface is black.
    """
    i, t, u, v = nearest(surfaces, groups, ox, oy, oz, dx, dy, dz, np.inf)
    if i < 0:
        return 0.0, 0.0, 0.0, t
    s = surfaces[i]
    _, _, _, nx, ny, nz = surface_point(s, u, v)
    facing = -(nx * dx + ny * dy + nz * dz)
    if facing <= 0:
        return 0.0, 0.0, 0.0, t
    # isotropic footprint of a slanted pixel: the geometric mean of its axes
    r, g, b = albedo(s, levels, texels, u, v, t * spread / sqrt(max(facing, 0.05)))
    if s.glow > 0:
        return r * s.glow, g * s.glow, b * s.glow, t
    lr, lg, lb = bilinear(light, s.light, s.light_height, s.light_width, u, v)
    r, g, b = r * lr, g * lg, b * lb
    if s.mirror >= 0:
        share = s.gloss + (1 - s.gloss) * 0.5 * (1 - facing) ** 5
        u, v = sphere_uv(dx + 2 * facing * nx, dy + 2 * facing * ny, dz + 2 * facing * nz)
        sr, sg, sb = bilinear(light, s.mirror, MIRROR_HEIGHT, 2 * MIRROR_HEIGHT, u, v)
        r, g, b = r + share * (sr - r), g + share * (sg - g), b + share * (sb - b)
    return r, g, b, t


@compiled
def trace_rays(tables: Any, origins: np.ndarray, directions: np.ndarray, spread: float, out: np.ndarray) -> None:
    """Fills out ``[R, 4]`` with r, g, b and distance along unit `directions` ``[R, 3]`` from `origins` ``[R, 3]``."""
    surfaces, groups, levels, texels, light = tables
    for k in range(len(origins)):
        ox, oy, oz = origins[k, 0], origins[k, 1], origins[k, 2]
        dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
        r, g, b, t = radiance(surfaces, groups, levels, texels, light, ox, oy, oz, dx, dy, dz, spread)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = r, g, b, t


@compiled
def trace_rows(
    tables: Any, eye: np.ndarray, rays: np.ndarray, spread: float, samples: int, first: int, out: np.ndarray
) -> None:
    """Averages ``samples * samples`` rays over the square of each pixel of some image rows.

    `rays` ``[3, 3]`` maps pixel coordinates (x, y, 1) to a world direction; `first` is the row of ``out[0]``. The
    samples of a pixel all differ in x and all differ in y, which smooths near-horizontal and near-vertical edges best.
    """
    surfaces, groups, levels, texels, light = tables
    weight = 1.0 / (samples * samples)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            r, g, b = 0.0, 0.0, 0.0
            for i in range(samples):
                for j in range(samples):
                    x = column + (i + (j + 0.5) / samples) / samples
                    y = first + row + (j + (i + 0.5) / samples) / samples
                    dx = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
                    dy = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
                    dz = rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]
                    f = 1 / sqrt(dx * dx + dy * dy + dz * dz)
                    sr, sg, sb, _ = radiance(
                        surfaces, groups, levels, texels, light,
                        eye[0], eye[1], eye[2], dx * f, dy * f, dz * f, spread,
                    )  # fmt: skip
                    # a lamp is clipped before it is averaged, or its edges would stay jagged
                    r, g, b = r + min(sr, 1.0), g + min(sg, 1.0), b + min(sb, 1.0)
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = r * weight, g * weight, b * weight


def camera_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The eye ``[3]`` and the matrix ``[3, 3]`` that takes pixel coordinates (x, y, 1) to an unnormalised direction."""
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    return camera.position.double().numpy(), viewmat[:3, :3].T @ np.linalg.inv(K)


def render_linear(tables: Tables, camera: Camera, samples: int) -> np.ndarray:
    """``[H, W, 3]`` float32 linear colours in 0..1, on all cores."""
    eye, rays = camera_rays(camera)
    spread = 1 / (float(camera.K[0, 0]) * samples)
    out = np.empty((camera.height, camera.width, 3), np.float32)
    rows = range(0, camera.height, ROWS)
    calls = (partial(trace_rows, tables, eye, rays, spread, samples, row, out[row : row + ROWS]) for row in rows)
    deque(in_order(calls, os.cpu_count() or 1), maxlen=0)
    return out


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear 0..1 (clipped) to uint8 sRGB."""
    x = np.clip(linear, 0, 1)
    return np.rint(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)).astype(np.uint8)


def decode_srgb(image: np.ndarray) -> np.ndarray:
    """uint8 sRGB to linear float32 in 0..1."""
    x = image.astype(np.float32) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
