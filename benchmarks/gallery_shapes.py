"""Scene builder: panels, boxes, balls and columns, collected into the ray tracer's `Tables`."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil

from gallery_intersect import CYLINDER, DISC, GROUP, QUAD, SPHERE, SURFACE
from gallery_raytrace import LEVEL, Tables

import numpy as np

DOWN = np.array([0.0, 1.0, 0.0])
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Finish:
    """Appearance of a surface.

    Attributes:
        texture: name of a texture given to `SceneBuilder`.
        tile: world size of one repetition; None stretches the texture over the surface.
        glow: emitted radiance of a lamp.
        gloss: reflectance at normal incidence.
        light_texel: target world size of a light map texel.
    """

    texture: str
    tile: float | None = None
    glow: float = 0.0
    gloss: float = 0.0
    light_texel: float = 0.05


@dataclass
class Surface:
    """One row of the `Tables`; extent is the world size along u and v."""

    kind: int
    origin: np.ndarray
    side_u: np.ndarray
    side_v: np.ndarray
    normal: np.ndarray
    extent: tuple[float, float]
    finish: Finish


@dataclass
class SceneBuilder:
    """Collects groups of surfaces.

    Attributes:
        textures: name to linear float32 ``[h, w, 3]``, sides powers of two.
        groups: surfaces that share a bounding box.
    """

    textures: dict[str, np.ndarray]
    groups: list[list[Surface]] = field(default_factory=list)

    def panel(
        self, centre: Vector, forward: Vector, size: tuple[float, float], finish: Finish, down: Vector = (0, 1, 0)
    ) -> None:
        """A flat rectangle, upright for a camera that looks along `forward` with `down` towards the image's bottom."""
        self.groups.append([panel(np.array(centre), np.array(forward), np.array(down), size, finish)])

    def box(
        self, base: Vector, size: Vector, finish: Finish, top: Finish | None = None, front: Finish | None = None,
        turn: float = 0.0, faces: str = "front back left right top",
    ) -> None:  # fmt: skip
        """A box on `base`; its size is along x, y, z before the rotation about the vertical.

        Args:
            turn: radians; the front looks to -z at 0, to -x at pi/2.
            faces: the faces to include, of front, back, left, right, top and bottom.
        """
        width, height, depth = size
        z = np.array([-np.sin(turn), 0, -np.cos(turn)])  # out of the front face
        x = np.cross(z, DOWN)
        centre = np.array(base) - DOWN * height / 2
        sides = {
            "front": (z, DOWN, depth, (width, height), front or finish),
            "back": (-z, DOWN, depth, (width, height), finish),
            "left": (-x, DOWN, width, (depth, height), finish),
            "right": (x, DOWN, width, (depth, height), finish),
            "top": (-DOWN, z, height, (width, depth), top or finish),
            "bottom": (DOWN, z, height, (width, depth), finish),
        }
        chosen = [sides[name] for name in faces.split()]
        self.groups.append([panel(centre + n * far / 2, -n, down, extent, f) for n, down, far, extent, f in chosen])

    def ball(self, centre: Vector, radius: float, finish: Finish) -> None:
        """A sphere; its texture maps longitude and latitude."""
        extent = (2 * np.pi * radius, np.pi * radius)
        self.groups.append([round_surface(SPHERE, centre, radius, 0.0, extent, finish)])

    def column(self, base: Vector, radius: float, height: float, finish: Finish, top: Finish) -> None:
        """An upright cylinder with a lid."""
        lid_centre = np.array(base) - DOWN * height
        lid = panel(lid_centre, DOWN, np.array([0.0, 0.0, -1.0]), (2 * radius, 2 * radius), top)
        lid.kind = DISC
        self.groups.append([round_surface(CYLINDER, base, radius, height, (2 * np.pi * radius, height), finish), lid])

    def tables(self) -> Tables:
        """The scene with all light maps at 1: colours are those of the textures until light is baked."""
        placed = [s for group in self.groups for s in group]
        first, levels, texels = mip_chain(list(self.textures.values()))
        span = {name: (first[k], first[k + 1]) for k, name in enumerate(self.textures)}
        surfaces = np.zeros(len(placed), SURFACE)
        for row, s in zip(surfaces, placed, strict=True):
            start, end = span[s.finish.texture]
            row["level"], row["levels"] = start, end - start
            fill_row(row, s, levels[start])
        area = surfaces["light_height"] * surfaces["light_width"]
        surfaces["light"] = np.cumsum(area) - area
        groups = np.zeros(len(self.groups), GROUP)
        groups["end"] = np.cumsum([len(group) for group in self.groups])
        groups["first"][1:] = groups["end"][:-1]
        bounds = np.array([group_bounds(group) for group in self.groups])
        for k, name in enumerate(("low_x", "low_y", "low_z", "high_x", "high_y", "high_z")):
            groups[name] = bounds[:, k]
        return Tables(surfaces, groups, levels, texels, np.ones((area.sum(), 3), np.float32))


def fill_row(row: np.void, s: Surface, finest: np.void) -> None:
    """Writes a surface's geometry and finish into its row of ``Tables.surfaces``; `finest` is its texture's level."""
    row["kind"] = s.kind
    for prefix, vector in (("", s.origin), ("a", s.side_u), ("b", s.side_v), ("n", s.normal)):
        row[prefix + "x"], row[prefix + "y"], row[prefix + "z"] = vector
    (width, height), finish = s.extent, s.finish
    tile_u, tile_v = (finish.tile, finish.tile) if finish.tile else s.extent
    row["repeat_u"], row["repeat_v"] = width / tile_u, height / tile_v
    row["texel"] = max(tile_u / finest["width"], tile_v / finest["height"])
    row["glow"], row["gloss"], row["mirror"] = finish.glow, finish.gloss, -1
    row["light_width"], row["light_height"] = (max(ceil(side / finish.light_texel), 2) for side in (width, height))


def panel(
    centre: np.ndarray, forward: np.ndarray, down: np.ndarray, size: tuple[float, float], finish: Finish
) -> Surface:
    """A rectangle of `size` (width, height) that faces against the unit vector `forward`."""
    right = np.cross(down, forward) * size[0]
    tall = down * size[1]
    return Surface(QUAD, centre - right / 2 - tall / 2, right, tall, -forward, size, finish)


def round_surface(
    kind: int, origin: Vector, radius: float, height: float, extent: tuple[float, float], finish: Finish
) -> Surface:
    """A sphere or the side of a cylinder, in the layout of `Tables`."""
    return Surface(
        kind, np.array(origin), np.array([radius, 0, 0]), np.array([height, 0, 0]), np.zeros(3), extent, finish
    )


def group_bounds(group: list[Surface]) -> np.ndarray:
    """``[6]`` low and high corner of the bounding box of surfaces, slightly enlarged against rounding."""
    corners = []
    for s in group:
        if s.kind <= DISC:
            corners += [s.origin + i * s.side_u + j * s.side_v for i in (0, 1) for j in (0, 1)]
            continue
        radius, height = s.side_u[0], s.side_v[0]
        below = radius if s.kind == SPHERE else 0.0
        corners += [s.origin - [radius, below + height, radius], s.origin + [radius, below, radius]]
    return np.concatenate([np.min(corners, 0) - 1e-6, np.max(corners, 0) + 1e-6])


def mip_chain(textures: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mip levels of every texture: first level of each ``[T + 1]``, all levels, all texels."""
    first, pages = [0], []
    for texture in textures:
        pages.append(texture.astype(np.float32))
        while min(pages[-1].shape[:2]) > 1:
            h, w = pages[-1].shape[:2]
            pages.append(pages[-1].reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3)))
        first.append(len(pages))
    levels = np.zeros(len(pages), LEVEL)
    levels["height"], levels["width"] = np.array([page.shape[:2] for page in pages]).T
    area = levels["height"] * levels["width"]
    levels["first"] = np.cumsum(area) - area
    return np.array(first), levels, np.concatenate([page.reshape(-1, 3) for page in pages])
