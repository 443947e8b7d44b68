"""A synthetic city of any number of Gaussians: streets, houses with windows, trees, cars, fields and a sky.

    python benchmarks/city.py OUT --count 1000000 --images 24 --size 800 500   # OUT/city.ply and a COLMAP scene

It stands in for captures that are too large to come with a repository. As with those, more Gaussians are more city: the
number of blocks grows with the count and the density stays, about 5 Gaussians a square metre of surface. Surfaces are
covered by thin Gaussians that lie in them, at a size that closes them whatever the count, a fifth of them as a coarser
layer; colours have detail down to single Gaussians, and all SH bands are in use.

World axes: x right, y DOWN, z into the picture, in metres; the ground is y = 0.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image

from clod_adapter.cameras import Camera
from clod_adapter.config import SH_COUNTS
from clod_adapter.gaussians import SH_C0, Gaussians
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.checkpoint import save
from clod_adapter.io.scene.colmap import write_model
from clod_adapter.rasterizers.reference import sh_basis
from clod_adapter.render import render

Where = Literal["near", "far", "mixed"]
LOT, STREET, LOTS = 16.0, 12.0, (2, 3)  # metres; lots in a block along x and z
PITCH = np.array([LOTS[0] * LOT + STREET, LOTS[1] * LOT + STREET])  # of the blocks
A_BLOCK = 30_000  # Gaussians, where there are enough for more than one block
ASPHALT, PAVING, GRASS, FACADE, ROOF, CAR, TREE, FIELD, SKY = range(9)
# Gaussians a unit of area, next to each other.
DENSITY = {ASPHALT: 0.5, PAVING: 0.8, GRASS: 0.6, FACADE: 1.0, ROOF: 0.6, CAR: 6.0, TREE: 1.5}
FAR = (1500, 0.02, 30_000)  # Gaussians of fields and sky: at least, of all, at most
SUN = np.array([0.45, -0.75, -0.48])
WALLS = np.array(
    [[0.62, 0.33, 0.26], [0.78, 0.72, 0.60], [0.66, 0.66, 0.64], [0.85, 0.82, 0.76], [0.55, 0.45, 0.38],
     [0.36, 0.45, 0.53], [0.80, 0.62, 0.45]]
)  # fmt: skip
PAINTS = np.array([[0.75, 0.1, 0.1], [0.9, 0.9, 0.9], [0.12, 0.13, 0.15], [0.15, 0.25, 0.5], [0.6, 0.62, 0.65]])
FIELDS = np.array([[0.42, 0.48, 0.25], [0.55, 0.52, 0.30], [0.30, 0.40, 0.22], [0.48, 0.42, 0.28]])
PERTURBED = {"means": 0.02, "log_scales": 0.15, "opacity_logits": 0.5, "sh0": 0.12}  # of a checkpoint, off the truth
BLUR = 0.1  # of a checkpoint: its Gaussians are larger than the truth by this, in logarithms


@dataclass(frozen=True)
class Surfaces:
    """R rectangles, or ellipsoids where the kind is TREE.

    Attributes:
        origin, u, v: ``[R, 3]`` a corner and the edges that leave it; of a tree the centre and, in u, the radii.
        normal: ``[R, 3]`` outward, unit length.
        kind: ``[R]`` ASPHALT to TREE.
        color: ``[R, 3]`` sRGB in [0, 1].
    """

    origin: np.ndarray
    u: np.ndarray
    v: np.ndarray
    normal: np.ndarray
    kind: np.ndarray
    color: np.ndarray

    def areas(self) -> np.ndarray:
        """``[R]`` square metres; of a tree about that of its crown."""
        flat = np.linalg.norm(np.cross(self.u, self.v), axis=1)
        return np.where(self.kind == TREE, 4 * np.pi * np.prod(self.u, axis=1) ** (2 / 3), flat)


@dataclass(frozen=True)
class Points:
    """N places for Gaussians: where, facing where, how far apart, of which kind and colour, each ``[N, ...]``."""

    position: np.ndarray
    normal: np.ndarray
    spacing: np.ndarray
    kind: np.ndarray
    color: np.ndarray


def blocks(count: int) -> int:
    """Of a city of this many Gaussians, along either axis."""
    return max(1, round(math.sqrt(count / A_BLOCK)))


def extent(count: int) -> np.ndarray:
    """``[2]`` metres along x and z; the city's middle is the origin."""
    return blocks(count) * PITCH


def city(count: int, *, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """``count`` Gaussians of a city, the same ones for the same arguments.

    Args:
        count: at least 1000.
        sh_degree: 0 to 4.
    """
    if count < 1000:
        raise SystemExit(f"a city needs at least 1000 Gaussians, not {count}")
    random = np.random.default_rng(seed)
    far = surrounding(count)
    parts = (cover(build(count, random), count - far, random), surround(far, count, random))
    names = ("position", "normal", "spacing", "kind", "color")
    points = Points(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    del parts
    noise = random.standard_normal((count, 3), np.float32)
    low = points.kind >= FIELD
    flat = np.where(low, np.float32(0.7), np.float32(0.5)) * points.spacing
    flat[: count - far : 5] *= 2.2  # the coarser layer
    log_scales = np.log(np.stack([flat, flat, 0.08 * flat], axis=1)) + 0.15 * noise
    logits = np.where(low, 3.0, 2.6 + 1.2 * noise[:, 0])
    shaded = shade(points, random)
    return Gaussians(
        means=torch.from_numpy(points.position),
        quats=torch.from_numpy(facing(points.normal, random)),
        log_scales=torch.from_numpy(log_scales.astype(np.float32)),
        opacity_logits=torch.from_numpy(logits.astype(np.float32)),
        sh0=torch.from_numpy((shaded - 0.5) / np.float32(SH_C0))[:, None],
        shN=torch.from_numpy(higher_bands(points, shaded, sh_degree, random)),
    )


def surrounding(count: int) -> int:
    """Gaussians of fields and sky in a city of ``count``; they are its last ones."""
    least, share, most = FAR
    return min(max(round(share * count), min(least, count // 5)), most)


def build(count: int, random: np.random.Generator) -> Surfaces:
    """Everything of the city that is covered: ground, houses, cars, trees."""
    n = blocks(count)
    corner = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), -1).reshape(-1, 2) * PITCH - n * PITCH / 2
    inner = corner + STREET / 2  # of the part without its streets
    size = PITCH - STREET
    park = (random.random(len(corner)) < 0.1) & (n > 1)
    step = np.stack(np.meshgrid(*(np.arange(k) for k in LOTS), indexing="ij"), -1).reshape(-1, 2) * LOT
    lots = (inner[~park, None] + step).reshape(-1, 2)
    houses, roofs = build_houses(lots, n, random)
    return joined([
        *streets(corner), *ring(lots, np.full(lots.shape, LOT), *houses), *roofs,
        ground(inner[park], np.broadcast_to(size, (park.sum(), 2)), GRASS, (0.25, 0.38, 0.16)),
        *park_cars(corner, random), plant(inner[park], size, corner, random),
    ])  # fmt: skip


def joined(parts: Sequence[Surfaces]) -> Surfaces:
    names = ("origin", "u", "v", "normal", "kind", "color")
    return Surfaces(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def rectangles(origin: np.ndarray, u: np.ndarray, v: np.ndarray, kind: int, color: np.ndarray) -> Surfaces:
    """Facing ``u x v``."""
    shape = np.broadcast_shapes(origin.shape, u.shape, v.shape)
    origin, u, v = (np.broadcast_to(a, shape).astype(np.float64) for a in (origin, u, v))
    normal = np.cross(u, v)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return Surfaces(origin, u, v, normal, np.full(len(origin), kind), np.broadcast_to(np.asarray(color), shape))


def ground(corner: np.ndarray, size: np.ndarray, kind: int, color: Sequence[float], height: float = 0.0) -> Surfaces:
    """Level rectangles from ``corner [R, 2]`` (x, z) on, of ``size [R, 2]`` metres."""
    zero = np.zeros(len(corner))
    origin = np.stack([corner[:, 0], zero - height, corner[:, 1]], 1)
    u, v = np.stack([size[:, 0], zero, zero], 1), np.stack([zero, zero, size[:, 1]], 1)
    return rectangles(origin, u, v, kind, np.asarray(color))


def box(low: np.ndarray, size: np.ndarray, base: np.ndarray, top: np.ndarray, kinds: tuple[int, int],
        color: np.ndarray, above: np.ndarray) -> list[Surfaces]:  # fmt: skip
    """Walls and roof of R boxes from ``low [R, 2]`` (x, z) on, between the heights ``base`` and ``top [R]``.

    Args:
        kinds: of the walls and of the roof; ``color`` and ``above`` are theirs.
    """
    zero = np.zeros(len(low))
    high, up = low + size, np.stack([zero, base - top, zero], 1)

    def at(x: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.stack([x, -base, z], 1)

    across, along = np.stack([size[:, 0], zero, zero], 1), np.stack([zero, zero, size[:, 1]], 1)
    walls = [
        rectangles(at(high[:, 0], low[:, 1]), -across, up, kinds[0], color),
        rectangles(at(low[:, 0], high[:, 1]), across, up, kinds[0], color),
        rectangles(at(low[:, 0], low[:, 1]), along, up, kinds[0], color),
        rectangles(at(high[:, 0], high[:, 1]), -along, up, kinds[0], color),
    ]
    roof = rectangles(np.stack([low[:, 0], -top, low[:, 1]], 1), along, across, kinds[1], above)
    return [*(outward(wall, low + size / 2) for wall in walls), outward(roof, low + size / 2)]


def outward(surfaces: Surfaces, middle: np.ndarray) -> Surfaces:
    """With normals away from the vertical axes through ``middle [R, 2]``, or up."""
    away = surfaces.origin + (surfaces.u + surfaces.v) / 2
    away[:, [0, 2]] -= middle
    away[:, 1] = -1e-3
    sign = np.where((away * surfaces.normal).sum(1, keepdims=True) < 0, -1.0, 1.0)
    return Surfaces(
        surfaces.origin, surfaces.u, surfaces.v, sign * surfaces.normal, surfaces.kind, surfaces.color
    )  # fmt: skip


def streets(corner: np.ndarray) -> list[Surfaces]:
    """The asphalt around every block."""
    half, (wide, deep) = STREET / 2, PITCH
    strips = [((0, 0), (wide, half)), ((0, deep - half), (wide, half)), ((0, half), (half, deep - STREET)),
              ((wide - half, half), (half, deep - STREET))]  # fmt: skip
    return [ground(corner + at, np.broadcast_to(size, corner.shape), ASPHALT, (0.3, 0.3, 0.32)) for at, size in strips]


def ring(lots: np.ndarray, size: np.ndarray, low: np.ndarray, house: np.ndarray) -> list[Surfaces]:
    """The paving of the lots around their houses."""
    high, end = low + house, lots + size
    strips = [
        (lots, np.stack([size[:, 0], low[:, 1] - lots[:, 1]], 1)),
        (np.stack([lots[:, 0], high[:, 1]], 1), np.stack([size[:, 0], end[:, 1] - high[:, 1]], 1)),
        (np.stack([lots[:, 0], low[:, 1]], 1), np.stack([low[:, 0] - lots[:, 0], house[:, 1]], 1)),
        (np.stack([high[:, 0], low[:, 1]], 1), np.stack([end[:, 0] - high[:, 0], house[:, 1]], 1)),
    ]
    return [ground(at, extent, PAVING, (0.6, 0.58, 0.55)) for at, extent in strips]


def build_houses(
    lots: np.ndarray, n: int, random: np.random.Generator
) -> tuple[tuple[np.ndarray, np.ndarray], list[Surfaces]]:
    """Where the houses stand (corner and size, ``[R, 2]``), and they: log-normal heights, higher in the middle."""
    count = len(lots)
    house = random.uniform(0.68, 0.86, (count, 2)) * LOT
    low = lots + (LOT - house) * random.uniform(0.35, 0.65, (count, 2))
    middle = np.linalg.norm((lots + LOT / 2) / (n * PITCH), axis=1)
    tall = random.lognormal(math.log(11), 0.4, count) * (1 + (1.6 * np.exp(-((middle / 0.22) ** 2)) if n > 2 else 0))
    tall = 3.2 * np.clip(np.rint(tall / 3.2), 2, 30) + 0.6
    color = np.clip(WALLS[random.integers(len(WALLS), size=count)] + random.normal(0, 0.025, (count, 3)), 0.1, 0.95)
    above = np.repeat(random.uniform(0.3, 0.55, (count, 1)), 3, 1) + random.normal(0, 0.015, (count, 3))
    zero = np.zeros(count)
    parts = box(low, house, zero, tall, (FACADE, ROOF), color, above)
    # Stair heads and plant rooms on the roofs, and a narrower storey or two on the tall ones.
    size = house * np.where(tall > 22, 0.7, 0.25)[:, None]
    on = low + (house - size) * random.random((count, 2))
    kinds = (FACADE, ROOF)
    return (low, house), parts + box(on, size, tall, tall + np.where(tall > 22, 7, 2.5), kinds, 0.9 * color, above)


def park_cars(corner: np.ndarray, random: np.random.Generator) -> list[Surfaces]:
    """Along the streets that run along z, on both sides: bodies, and cabins on them."""
    a_side = int((PITCH[1] - STREET) // 6)
    slots = np.stack([np.repeat([2.6, PITCH[0] - 4.4], a_side), np.tile(STREET / 2 + 6.0 * np.arange(a_side), 2)], 1)
    at = (corner[:, None] + slots).reshape(-1, 2)
    at = at[random.random(len(at)) < 0.45]
    at[:, 1] += random.uniform(0, 1.2, len(at))
    size = np.broadcast_to((1.8, 4.3), at.shape)
    paint, one = PAINTS[random.integers(len(PAINTS), size=len(at))], np.ones(len(at))
    body = box(at, size, 0.3 * one, 0.9 * one, (CAR, CAR), paint, paint)
    glass = np.broadcast_to((0.1, 0.12, 0.15), paint.shape)
    return body + box(at + (0.15, 0.9), size - (0.3, 1.9), 0.9 * one, 1.5 * one, (CAR, CAR), glass, paint)


def plant(inner: np.ndarray, size: np.ndarray, corner: np.ndarray, random: np.random.Generator) -> Surfaces:
    """Crowns of trees: many in the parks ``inner [P, 2]``, and some beside the streets that run along x."""
    parks = (inner[:, None] + random.uniform(0.05, 0.95, (len(inner), 24, 2)) * size).reshape(-1, 2)
    row = STREET / 2 + 4 + 8 * np.arange(int((PITCH[0] - STREET) // 8))
    slots = np.concatenate([np.stack([row, np.full(len(row), z)], 1) for z in (4.4, PITCH[1] - 4.4)])
    beside = (corner[:, None] + slots).reshape(-1, 2)
    at = np.concatenate([parks, beside[random.random(len(beside)) < 0.5]])
    radii = random.uniform(1.3, 2.3, (len(at), 1)) * random.uniform(0.8, 1.2, (len(at), 3))
    centre = np.stack([at[:, 0], -2.2 - radii[:, 1], at[:, 1]], 1)
    color = np.array([0.2, 0.36, 0.13]) + random.normal(0, 0.04, (len(at), 3))
    return Surfaces(centre, radii, radii, np.zeros(centre.shape), np.full(len(at), TREE), color)


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
    return Points(
        position.astype(np.float32), normal.astype(np.float32), spacing.astype(np.float32), kinds, color
    )  # fmt: skip


def on_sphere(spot: np.ndarray) -> np.ndarray:
    """``[N, 3]`` directions, even over the sphere where ``spot [N, 2]`` is even over the unit square."""
    y = 1 - 2 * spot[:, 0]
    turn, r = 2 * np.pi * spot[:, 1], np.sqrt(np.maximum(1 - y * y, 0))
    return np.stack([r * np.cos(turn), y, r * np.sin(turn)], 1)


def pattern(surfaces: Surfaces, row: np.ndarray, spot: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """``[N, 3]`` float32 colour of the points at ``spot`` of surface ``row``: windows, markings, stains."""
    kind, color = surfaces.kind[row], surfaces.color[row].astype(np.float32)
    color *= (1 + random.normal(0, 0.05, (len(row), 1))).astype(np.float32)
    wall = np.flatnonzero(kind == FACADE)
    along = spot[wall, 0] * np.linalg.norm(surfaces.u, axis=1)[row[wall]]
    up = spot[wall, 1] * np.linalg.norm(surfaces.v, axis=1)[row[wall]]
    storey, bay = np.floor(up / 3.2), np.floor(along / 2.6)
    window = (up % 3.2 > 0.9) & (up % 3.2 < 2.6) & (along % 2.6 > 0.6) & (along % 2.6 < 2.0)
    pick = (np.sin(row[wall] * 12.9898 + storey * 78.233 + bay * 37.719) * 43758.5453) % 1.0  # one number a window
    pane = np.where((pick < 0.12)[:, None], [0.85, 0.75, 0.5], [0.13, 0.19, 0.27] + 0.25 * pick[:, None] ** 3)
    color[wall] *= (0.72 + 0.28 * (1 - np.exp(-up / 4)))[:, None]  # darker towards the street
    color[wall[window]] = pane[window]
    road = np.flatnonzero(kind == ASPHALT)
    at = surfaces.origin[row[road]] + spot[road, :1] * surfaces.u[row[road]] + spot[road, 1:] * surfaces.v[row[road]]
    inside = (at[:, [0, 2]] - surfaces.origin[surfaces.kind == ASPHALT][0, [0, 2]]) % PITCH
    edge = np.minimum(inside, PITCH - inside)  # from the middles of the streets
    line = ((edge[:, 0] < 0.25) & (inside[:, 1] % 6 < 3)) | ((edge[:, 1] < 0.25) & (inside[:, 0] % 6 < 3))
    line &= edge.max(1) > STREET / 2
    color[road[line]] = [0.85, 0.85, 0.8]
    return color


def surround(count: int, whole: int, random: np.random.Generator) -> Points:
    """Fields around the city, and a sky over it: few and large."""
    reach = 6 * float(extent(whole).max())
    fields = 4 * count // 5
    k = np.arange(count)
    spot = np.stack([k * 0.7548776662466927 + 0.5, k * 0.5698402909980532 + 0.5], 1) % 1.0
    near = float(np.hypot(*extent(whole))) / 2 * 0.7
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


def higher_bands(points: Points, color: np.ndarray, degree: int, random: np.random.Generator) -> np.ndarray:
    """``[N, K-1, 3]`` float32: a lobe where the sun is mirrored, stronger on glass, and noise as training leaves it."""
    k = SH_COUNTS[degree]
    bands = np.empty((len(color), k - 1, 3), np.float32)
    if k == 1:
        return bands
    sun = (SUN / np.linalg.norm(SUN)).astype(np.float32)
    band = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)[1:]
    fall = (0.9**band / (1 + band)).astype(np.float32)[:, None]
    for at in range(0, len(color), 500_000):
        rows = slice(at, at + 500_000)
        normal = points.normal[rows]
        mirrored = 2 * (normal @ sun)[:, None] * normal - sun  # from the surface; a view looks along its opposite
        lobe = sh_basis(torch.from_numpy(-mirrored)).numpy()[:, 1:k, None]
        shine = np.where(color[rows].mean(1) < 0.3, 0.35, 0.1).astype(np.float32)[:, None, None]
        noise = random.standard_normal((len(normal), k - 1, 3), np.float32)
        bands[rows] = fall * (shine * lobe + 0.03 * noise)
    return bands


def city_cameras(
    n: int, width: int, height: int, *, where: Where = "mixed", count: int, seed: int = 0
) -> list[Camera]:  # fmt: skip
    """``n`` cameras in a city of ``count`` Gaussians, named ``view_0000.png`` on.

    Args:
        where: "near": in the streets, at eye height and a little above; "far": from the air, looking down on the city
            at about 40 degrees, from all sides; "mixed": the two in turn.
    """
    random = np.random.default_rng(seed + 1)
    cameras = []
    for k in range(n):
        close = where == "near" or (where == "mixed" and k % 2 == 0)
        eye, target = (in_street if close else in_air)(count, random)
        cameras.append(look_at(eye, target, width, height, f"view_{k:04d}.png"))
    return cameras


def in_street(count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target of a camera on a street, looking along it more than across."""
    n, axis = blocks(count), int(random.integers(2))
    street = random.integers(0, n + 1) if n < 3 else random.integers(1, n)
    eye, ahead = np.zeros(2), np.zeros(2)
    eye[axis] = street * PITCH[axis] - n * PITCH[axis] / 2 + random.uniform(-2, 2)
    eye[1 - axis] = random.uniform(-0.45, 0.45) * n * PITCH[1 - axis]
    ahead[1 - axis] = -np.sign(eye[1 - axis])
    turn = math.radians(random.uniform(-25, 25))
    ahead = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ ahead
    up = random.uniform(1.7, 4.5)
    target = np.array([eye[0] + 20 * ahead[0], -up - random.uniform(0, 5), eye[1] + 20 * ahead[1]])
    return np.array([eye[0], -up, eye[1]]), target


def in_air(count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target of a camera above, a share of the city's size away."""
    size, turn = extent(count), random.uniform(0, 2 * np.pi)
    aim = random.uniform(-0.2, 0.2, 2) * size
    away, pitch = random.uniform(0.55, 1.1) * float(size.max()), math.radians(random.uniform(28, 50))
    level = away * math.cos(pitch)
    eye = np.array([
        aim[0] + level * math.cos(turn), -max(away * math.sin(pitch), 30.0), aim[1] + level * math.sin(turn)
    ])  # fmt: skip
    return eye, np.array([aim[0], -5.0, aim[1]])


def look_at(eye: np.ndarray, target: np.ndarray, width: int, height: int, name: str) -> Camera:
    """An upright camera with a field of view of 65 degrees across the width."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    focal = width / 2 / math.tan(math.radians(65) / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(K).float(), width, height, name)


def perturb(truth: Gaussians, seed: int = 0) -> Gaussians:
    """A checkpoint as training might have left it: the truth a little blurred and off, in place; it is the result."""
    generator = torch.Generator().manual_seed(seed)
    size = truth.log_scales[:, :2].mean(1, keepdim=True).exp()
    for name, by in PERTURBED.items():
        values = getattr(truth, name)
        noise = torch.randn(values.shape, generator=generator).mul_(by)
        values += noise * size / 0.15 if name == "means" else noise
    truth.log_scales.add_(BLUR)
    return truth


def write_city(
    folder: str | Path, count: int, images: int, width: int, height: int, *, where: Where = "mixed", seed: int = 0,
    sh_degree: int = 3,
) -> None:  # fmt: skip
    """A checkpoint ``folder/city.ply`` and photographs of what it should be, as a COLMAP scene in the folder.

    Args:
        folder: does not exist or is empty; it appears when everything in it is complete.
    """
    truth = city(count, seed=seed, sh_degree=sh_degree)
    cameras = city_cameras(images, width, height, where=where, count=count, seed=seed)
    with atomic_path(folder) as part:
        (part / "images").mkdir(parents=True)
        for camera in cameras:
            with torch.no_grad():
                Image.fromarray(render(truth, camera).pixels.numpy()).save(part / "images" / camera.name)
        some = np.linspace(0, count - surrounding(count), 2000, endpoint=False).astype(np.int64)
        colors = ((0.5 + SH_C0 * truth.sh0[some, 0].numpy()).clip(0, 1) * 255).astype(np.uint8)
        write_model(part, cameras, [camera.name for camera in cameras], truth.means[some].numpy(), colors)
        save(part / "city.ply", perturb(truth, seed))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", help="a folder that does not exist or is empty")
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians (default: %(default)s)")
    parser.add_argument("--images", type=int, default=24, help="photographs (default: %(default)s)")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 400), metavar=("W", "H"), help="of a photograph")
    parser.add_argument("--where", choices=("near", "far", "mixed"), default="mixed", help="cameras (default: mixed)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sh-degree", type=int, default=3)
    args = parser.parse_args()
    write_city(
        args.out, args.count, args.images, *args.size, where=args.where, seed=args.seed, sh_degree=args.sh_degree
    )


if __name__ == "__main__":
    main()
