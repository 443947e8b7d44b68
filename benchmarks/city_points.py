"""The Gaussians of the synthetic city: points on its surfaces, of its fields and sky, with colour and orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import city_surfaces as surface
from city_surfaces import FIELD, PITCH, SKY, TREE, Surfaces, extent
from clod_adapter.config import SH_COUNTS
from clod_adapter.rasterizers.reference import sh_basis

import numpy as np
import torch

# Gaussians per unit of area, relative to each other.
DENSITY = {surface.ASPHALT: 0.5, surface.PAVING: 0.8, surface.GRASS: 0.6, surface.FACADE: 1.0, surface.ROOF: 0.6,
           surface.CAR: 6.0, TREE: 1.5}  # fmt: skip
SUN = np.array([0.45, -0.75, -0.48])
FIELDS = np.array([[0.42, 0.48, 0.25], [0.55, 0.52, 0.30], [0.30, 0.40, 0.22], [0.48, 0.42, 0.28]])


@dataclass(frozen=True)
class Points:
    """N positions of Gaussians, with normal, spacing, kind and colour, each ``[N, ...]``."""

    position: np.ndarray
    normal: np.ndarray
    spacing: np.ndarray
    kind: np.ndarray
    color: np.ndarray


def cover(surfaces: Surfaces, count: int, random: np.random.Generator) -> Points:
    """``count`` points on the surfaces, evenly spread on each (the R2 sequence), by area and DENSITY."""
    areas = surfaces.areas()
    weight = areas * np.array([DENSITY[kind] for kind in sorted(DENSITY)])[surfaces.kind]
    ends = np.rint(count * np.cumsum(weight) / weight.sum()).astype(np.int64)
    here = np.diff(ends, prepend=0)
    row = np.repeat(np.arange(len(here)), here)
    k = np.arange(count) - (ends - here)[row]
    spot = np.stack([k * 0.7548776662466927 + 0.5, k * 0.5698402909980532 + 0.5], 1) % 1.0
    kind = surfaces.kind[row]
    spacing = np.sqrt(areas / np.maximum(here, 1))[row]
    position = surfaces.origin[row] + spot[:, :1] * surfaces.u[row] + spot[:, 1:] * surfaces.v[row]
    normal = surfaces.normal[row]
    color = pattern(surfaces, row, spot, random)
    tree = np.flatnonzero(kind == TREE)
    normal[tree] = on_sphere(spot[tree])
    depth = random.uniform(0.65, 1.0, (len(tree), 1))
    position[tree] = surfaces.origin[row[tree]] + depth * normal[tree] * surfaces.u[row[tree]]
    color[tree] *= 0.55 + 0.45 * (depth - 0.65) / 0.35 + random.normal(0, 0.15, (len(tree), 1))
    kinds = kind.astype(np.int8)
    return Points(position.astype(np.float32), normal.astype(np.float32), spacing.astype(np.float32), kinds, color)


def on_sphere(spot: np.ndarray) -> np.ndarray:
    """``[N, 3]`` directions, even over the sphere where ``spot [N, 2]`` is even over the unit square."""
    y = 1 - 2 * spot[:, 0]
    turn, r = 2 * np.pi * spot[:, 1], np.sqrt(np.maximum(1 - y * y, 0))
    return np.stack([r * np.cos(turn), y, r * np.sin(turn)], 1)


def pattern(surfaces: Surfaces, row: np.ndarray, spot: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """``[N, 3]`` float32 colour of the points at ``spot`` of surface ``row``: windows, markings, stains."""
    kind, color = surfaces.kind[row], surfaces.color[row].astype(np.float32)
    color *= (1 + random.normal(0, 0.05, (len(row), 1))).astype(np.float32)
    wall = np.flatnonzero(kind == surface.FACADE)
    along = spot[wall, 0] * np.linalg.norm(surfaces.u, axis=1)[row[wall]]
    up = spot[wall, 1] * np.linalg.norm(surfaces.v, axis=1)[row[wall]]
    storey, bay = np.floor(up / 3.2), np.floor(along / 2.6)
    window = (up % 3.2 > 0.9) & (up % 3.2 < 2.6) & (along % 2.6 > 0.6) & (along % 2.6 < 2.0)
    pick = (np.sin(row[wall] * 12.9898 + storey * 78.233 + bay * 37.719) * 43758.5453) % 1.0  # one number a window
    pane = np.where((pick < 0.12)[:, None], [0.85, 0.75, 0.5], [0.13, 0.19, 0.27] + 0.25 * pick[:, None] ** 3)
    color[wall] *= (0.72 + 0.28 * (1 - np.exp(-up / 4)))[:, None]  # darker towards the street
    color[wall[window]] = pane[window]
    road = np.flatnonzero(kind == surface.ASPHALT)
    at = surfaces.origin[row[road]] + spot[road, :1] * surfaces.u[row[road]] + spot[road, 1:] * surfaces.v[row[road]]
    inside = (at[:, [0, 2]] - surfaces.origin[surfaces.kind == surface.ASPHALT][0, [0, 2]]) % PITCH
    edge = np.minimum(inside, PITCH - inside)  # from the middles of the streets
    line = ((edge[:, 0] < 0.25) & (inside[:, 1] % 6 < 3)) | ((edge[:, 1] < 0.25) & (inside[:, 0] % 6 < 3))
    line &= edge.max(1) > surface.STREET / 2
    color[road[line]] = [0.85, 0.85, 0.8]
    return color


def surround(count: int, whole: int, random: np.random.Generator) -> Points:
    """Fields around the city, and a sky over it: few and large."""
    reach = 6 * float(extent(whole).max())
    fields = 4 * count // 5
    k = np.arange(count)
    spot = np.stack([k * 0.7548776662466927 + 0.5, k * 0.5698402909980532 + 0.5], 1) % 1.0
    near = float(extent(whole).min()) / 2  # they begin below the city, which leaves no gap
    away, turn = near * (reach / near) ** spot[:fields, 0], 2 * np.pi * spot[:fields, 1]
    at = np.stack([away * np.cos(turn), np.full(fields, 1.2), away * np.sin(turn)], 1)
    up = np.broadcast_to([0.0, -1.0, 0.0], at.shape)
    cell = np.floor(at[:, [0, 2]] / (70, 45)) @ (12.9898, 78.233)
    patch = (np.sin(cell) * 43758.5453 % 1.0 * len(FIELDS)).astype(np.int64)
    sky = on_sphere(np.stack([0.47 + 0.53 * spot[fields:, 0], spot[fields:, 1]], 1))
    height = np.maximum(-sky[:, 1:2], 0)
    blue = np.array([0.86, 0.9, 0.95]) * (1 - height**0.5) + np.array([0.33, 0.55, 0.85]) * height**0.5
    dome_spacing = reach * math.sqrt(2 * np.pi * 1.06 / max(count - fields, 1))
    return Points(
        np.concatenate([at, reach * sky]).astype(np.float32), np.concatenate([up, -sky]).astype(np.float32),
        np.concatenate([away * math.sqrt(2 * np.pi * math.log(reach / near) / max(fields, 1)),
                        np.full(count - fields, dome_spacing)]).astype(np.float32),
        np.repeat(np.array([FIELD, SKY], np.int8), [fields, count - fields]),
        np.concatenate([FIELDS[patch], blue]).astype(np.float32),
    )  # fmt: skip


def shade(points: Points, random: np.random.Generator) -> np.ndarray:
    """``[N, 3]`` float32: the colours in the sun, with a little grain."""
    sun = (points.normal @ (SUN / np.linalg.norm(SUN)).astype(np.float32)).clip(min=0)
    light = np.where(points.kind == SKY, 1.0, 0.58 + 0.5 * sun).astype(np.float32)
    grain = 0.015 * random.standard_normal(len(light), np.float32)
    return (points.color * light[:, None] + grain[:, None]).clip(0.02, 0.98)


def facing(normal: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """``[N, 4]`` float32 wxyz: rotations that turn z into ``normal``, with any spin about it."""
    x, y, z = normal.T
    back = z < -0.999
    w = np.where(back, 0, 1 + z)
    q = np.stack([w, np.where(back, 1, -y), np.where(back, 0, x)], 1)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    spin = np.pi * random.random(len(q), np.float32)
    c, s = np.cos(spin), np.sin(spin)
    w, i, j = q.T
    return np.stack([w * c, i * c + j * s, j * c - i * s, w * s], 1).astype(np.float32)


def higher_degrees(points: Points, color: np.ndarray, degree: int, random: np.random.Generator) -> np.ndarray:
    """``[N, K-1, 3]`` float32: a lobe where the sun is mirrored, stronger on glass, and noise."""
    k = SH_COUNTS[degree]
    coefficients = np.empty((len(color), k - 1, 3), np.float32)
    if k == 1:
        return coefficients
    sun = (SUN / np.linalg.norm(SUN)).astype(np.float32)
    degrees = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)[1:]
    fall = (0.9**degrees / (1 + degrees)).astype(np.float32)[:, None]
    for at in range(0, len(color), 500_000):
        rows = slice(at, at + 500_000)
        normal = points.normal[rows]
        mirrored = 2 * (normal @ sun)[:, None] * normal - sun  # from the surface; a view looks along its opposite
        lobe = sh_basis(torch.from_numpy(-mirrored)).numpy()[:, 1:k, None]
        shine = np.where(color[rows].mean(1) < 0.3, 0.35, 0.1).astype(np.float32)[:, None, None]
        noise = random.standard_normal((len(normal), k - 1, 3), np.float32)
        coefficients[rows] = fall * (shine * lobe + 0.03 * noise)
    return coefficients
