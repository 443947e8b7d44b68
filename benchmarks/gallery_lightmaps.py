"""Bakes the light of a scene: soft shadows of lamps, indirect light, reflections of glossy balls.

Light is stored on the surfaces: a render costs one ray per sample, and matt surfaces do not depend on the view.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from functools import partial
from math import cos, pi, sin, sqrt
from typing import Any

from clod_adapter._support.workers import in_order
from gallery_intersect import compiled, nearest, surface_point
from gallery_raytrace import MIRROR_HEIGHT, Tables, radiance, trace_rays

import numpy as np

LIFT = 1e-4  # world units from the surface to the origin of a ray
GATHER_SPREAD = 0.2  # width of a gathering ray per unit of distance: coarse textures, less noise
LAMP_RAYS, BOUNCE_RAYS = 5, 8  # strata per axis; a texel gets their squares in rays, per lamp and per bounce
BOUNCES = 2  # reflections between surfaces
BLOCK = 2048  # light map texels per task


@compiled
def lamp_light(
    tables: Any, lamps: np.ndarray, where: np.ndarray, uv: np.ndarray, jitter: np.ndarray, n: int, out: np.ndarray
) -> None:
    """Fills out ``[K, 3]`` with the lamps' irradiance / pi at texels `uv` ``[K, 2]`` of surfaces `where` ``[K]``.

    ``n * n`` stratified points per lamp, shifted by `jitter` ``[K, 2]``.
    """
    surfaces, groups = tables.surfaces, tables.groups
    for k in range(len(where)):
        px, py, pz, nx, ny, nz = surface_point(surfaces[where[k]], uv[k, 0], uv[k, 1])
        px, py, pz = px + LIFT * nx, py + LIFT * ny, pz + LIFT * nz
        total = 0.0
        for i in range(len(lamps)):
            lamp = surfaces[lamps[i]]
            area = sqrt((lamp.ax**2 + lamp.ay**2 + lamp.az**2) * (lamp.bx**2 + lamp.by**2 + lamp.bz**2))
            for s in range(n * n):
                u, v = (s % n + jitter[k, 0]) / n, (s // n + jitter[k, 1]) / n
                qx, qy, qz, mx, my, mz = surface_point(lamp, u, v)
                dx, dy, dz = qx - px, qy - py, qz - pz
                far = sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx / far, dy / far, dz / far
                cosines = (nx * dx + ny * dy + nz * dz) * max(-(mx * dx + my * dy + mz * dz), 0.0)
                if cosines > 0 and nearest(surfaces, groups, px, py, pz, dx, dy, dz, far - 2 * LIFT)[0] < 0:
                    total += lamp.glow * area * cosines / (far * far * n * n * pi)
        out[k, 0], out[k, 1], out[k, 2] = total, total, total


@compiled
def bounced_light(tables: Any, where: np.ndarray, uv: np.ndarray, jitter: np.ndarray, n: int, out: np.ndarray) -> None:
    """Fills out ``[K, 3]`` with the mean radiance of other surfaces along ``n * n`` cosine-weighted rays.

    Lamps must not glow here: `lamp_light` adds their light, with less noise.
    """
    surfaces, groups, levels, texels, light = tables
    for k in range(len(where)):
        px, py, pz, nx, ny, nz = surface_point(surfaces[where[k]], uv[k, 0], uv[k, 1])
        px, py, pz = px + LIFT * nx, py + LIFT * ny, pz + LIFT * nz
        # any tangent frame
        ax, ay, az = (nz, 0.0, -nx) if abs(ny) < 0.9 else (0.0, -nz, ny)
        f = 1 / sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax * f, ay * f, az * f
        bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        r, g, b = 0.0, 0.0, 0.0
        for s in range(n * n):
            out_square, turn = (s % n + jitter[k, 0]) / n, 2 * pi * (s // n + jitter[k, 1]) / n
            radius, height = sqrt(out_square), sqrt(1 - out_square)
            x, y = radius * cos(turn), radius * sin(turn)
            dx, dy, dz = x * ax + y * bx + height * nx, x * ay + y * by + height * ny, x * az + y * bz + height * nz
            sr, sg, sb, _ = radiance(surfaces, groups, levels, texels, light, px, py, pz, dx, dy, dz, GATHER_SPREAD)
            r, g, b = r + sr, g + sg, b + sb
        out[k, 0], out[k, 1], out[k, 2] = r / (n * n), g / (n * n), b / (n * n)


def bake_light(tables: Tables) -> Tables:
    """The scene, lit by its lamps; a closed one (every ray hits something), its light maps at any value."""
    where, uv, jitter = light_texels(tables.surfaces)
    lamps = np.flatnonzero(tables.surfaces["glow"])
    direct = in_blocks(len(where), lambda k, out: lamp_light(tables, lamps, where[k], uv[k], jitter[k], LAMP_RAYS, out))
    direct = smoothed(direct, tables.surfaces, 1)
    dark = tables.surfaces.copy()
    dark["glow"] = 0

    def bounced(light: np.ndarray) -> np.ndarray:
        scene = tables._replace(surfaces=dark, light=light)
        found = in_blocks(len(where), lambda k, out: bounced_light(scene, where[k], uv[k], jitter[k], BOUNCE_RAYS, out))
        return smoothed(found, tables.surfaces, 2)

    light = direct
    for _ in range(BOUNCES):
        light = direct + bounced(light)
    return with_mirrors(tables._replace(light=light))


def light_texels(surfaces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Surface ``[K]``, centre u, v and jitter of every light map texel, in the order of ``Tables.light``.

    The jitter ``[K, 2]`` repeats every four texels, so a blur that wide averages 16 interleaved sets of rays.
    """
    where = np.repeat(np.arange(len(surfaces)), surfaces["light_height"] * surfaces["light_width"])
    s = surfaces[where]
    row, column = np.divmod(np.arange(len(where)) - s["light"], s["light_width"])
    uv = np.stack([(column + 0.5) / s["light_width"], (row + 0.5) / s["light_height"]], 1)
    return where, uv, (np.stack([(column + row) % 4, row % 4], 1) + 0.5) / 4


def in_blocks(count: int, fill: Callable[[slice, np.ndarray], None]) -> np.ndarray:
    """``[count, 3]`` float32, filled block by block on all cores."""
    out = np.empty((count, 3), np.float32)
    parts = [slice(k, k + BLOCK) for k in range(0, count, BLOCK)]
    deque(in_order((partial(fill, part, out[part]) for part in parts), os.cpu_count() or 1), maxlen=0)
    return out


def smoothed(light: np.ndarray, surfaces: np.ndarray, passes: int) -> np.ndarray:
    """Light maps blurred over four texels along each axis (five, the outer two at half weight)."""
    out = light.copy()
    for s in surfaces:
        height, width = s["light_height"], s["light_width"]
        page = out[s["light"] : s["light"] + height * width].reshape(height, width, 3)
        for _ in range(passes):
            wide = np.pad(page, ((2, 2), (2, 2), (0, 0)), mode="edge")
            tall = wide[:-4] + 2 * (wide[1:-3] + wide[2:-2] + wide[3:-1]) + wide[4:]
            page[:] = (tall[:, :-4] + 2 * (tall[:, 1:-3] + tall[:, 2:-2] + tall[:, 3:-1]) + tall[:, 4:]) / 64
    return out


def with_mirrors(tables: Tables, sharpness: float = 40.0) -> Tables:
    """Adds an environment map of every glossy sphere, filtered by a cosine lobe with exponent ``sharpness``."""
    shape = (MIRROR_HEIGHT, 2 * MIRROR_HEIGHT)
    v, u = (np.indices(shape).reshape(2, -1) + 0.5) / np.array([shape]).T
    turn = (u - 0.5) * 2 * pi
    directions = np.stack([np.sin(v * pi) * np.sin(turn), -np.cos(v * pi), np.sin(v * pi) * np.cos(turn)], 1)
    lobe = np.clip(directions @ directions.T, 0, 1) ** sharpness * np.sin(v * pi)
    lobe /= lobe.sum(1, keepdims=True)
    surfaces, light = tables.surfaces.copy(), [tables.light]
    for i in np.flatnonzero(surfaces["gloss"]):
        s = surfaces[i]
        origins = np.array([s["x"], s["y"], s["z"]]) + directions * s["ax"] * 1.001
        seen = np.empty((len(directions), 4))
        trace_rays(tables, origins, directions, pi / MIRROR_HEIGHT, seen)
        surfaces["mirror"][i] = sum(map(len, light))
        light.append((lobe @ seen[:, :3]).astype(np.float32))
    return tables._replace(surfaces=surfaces, light=np.concatenate(light))
