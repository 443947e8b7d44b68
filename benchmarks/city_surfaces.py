"""The surfaces of the synthetic city: streets, houses, cars and trees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

LOT, STREET, LOTS = 16.0, 12.0, (2, 3)  # metres; lots in a block along x and z
PITCH = np.array([LOTS[0] * LOT + STREET, LOTS[1] * LOT + STREET])  # of the blocks
A_BLOCK = 30_000  # Gaussians, where there are enough for more than one block
ASPHALT, PAVING, GRASS, FACADE, ROOF, CAR, TREE, FIELD, SKY = range(9)
WALLS = np.array(
    [[0.62, 0.33, 0.26], [0.78, 0.72, 0.60], [0.66, 0.66, 0.64], [0.85, 0.82, 0.76], [0.55, 0.45, 0.38],
     [0.36, 0.45, 0.53], [0.80, 0.62, 0.45]]
)  # fmt: skip
PAINTS = np.array([[0.75, 0.1, 0.1], [0.9, 0.9, 0.9], [0.12, 0.13, 0.15], [0.15, 0.25, 0.5], [0.6, 0.62, 0.65]])


@dataclass(frozen=True)
class Surfaces:
    """R rectangles, or ellipsoids where the kind is TREE."""

    origin: np.ndarray  # [R, 3] a corner; of a tree the centre
    u: np.ndarray  # [R, 3] an edge; of a tree the radii
    v: np.ndarray  # [R, 3] the other edge
    normal: np.ndarray  # [R, 3] outward, unit length
    kind: np.ndarray  # [R] ASPHALT to TREE
    color: np.ndarray  # [R, 3] sRGB in [0, 1]

    def areas(self) -> np.ndarray:
        """``[R]`` square metres; of a tree about that of its crown."""
        flat = np.linalg.norm(np.cross(self.u, self.v), axis=1)
        return np.where(self.kind == TREE, 4 * np.pi * np.prod(self.u, axis=1) ** (2 / 3), flat)


def blocks(count: int) -> int:
    """Of a city of this many Gaussians, along either axis."""
    return max(1, round(math.sqrt(count / A_BLOCK)))


def extent(count: int) -> np.ndarray:
    """``[2]`` metres along x and z; the city's middle is the origin."""
    return blocks(count) * PITCH


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


def joined(parts: Sequence[Any]) -> Any:
    """One of several dataclasses of arrays."""
    names = [field.name for field in fields(parts[0])]
    return type(parts[0])(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


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
    return replace(surfaces, normal=sign * surfaces.normal)


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
    size, top = house * np.where(tall > 22, 0.7, 0.25)[:, None], tall + np.where(tall > 22, 7, 2.5)
    on = low + (house - size) * random.random((count, 2))
    return (low, house), parts + box(on, size, tall, top, (FACADE, ROOF), 0.9 * color, above)


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
