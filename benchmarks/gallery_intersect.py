"""Compiled intersections of rays with flat rectangles, discs, spheres and upright cylinders.

World axes have y pointing down. Rays are six floats, origin and direction. Compiled code writes vectors component by
component, which is fastest.
"""

from __future__ import annotations

from math import acos, atan2, cos, pi, sin, sqrt
from typing import Any

import numpy as np
from numba import njit

QUAD, DISC, SPHERE, CYLINDER = range(4)
# Not cached on disk: numba does not detect changes of functions inlined from other files.
compiled = njit(nogil=True, error_model="numpy")


def record(integers: str, floats: str) -> np.dtype:
    """Type of a row of a scene table, with named int64 and float64 columns."""
    return np.dtype([(name, np.int64) for name in integers.split()] + [(name, np.float64) for name in floats.split()])


# A quad or disc holds x + a u + b v for u, v in 0..1, and n points to its visible side. A sphere has its centre in x
# and its radius in ax. A cylinder has its base in x, radius ax and height bx. `raytrace.Tables` has the other fields.
SURFACE = record(
    "kind level levels light light_height light_width mirror",
    "x y z ax ay az bx by bz nx ny nz repeat_u repeat_v texel glow gloss",
)
GROUP = record("first end", "low_x low_y low_z high_x high_y high_z")  # consecutive surfaces with a common bounding box


@compiled
def sphere_uv(x: float, y: float, z: float) -> Any:
    """Longitude and latitude of a unit direction as u, v in 0..1; v = 0 is up (y = -1)."""
    return atan2(x, z) / (2 * pi) + 0.5, acos(min(max(-y, -1.0), 1.0)) / pi


@compiled
def surface_point(s: Any, u: float, v: float) -> Any:
    """Position and unit normal at (u, v) of a surface, six floats."""
    if s.kind <= DISC:
        return s.x + u * s.ax + v * s.bx, s.y + u * s.ay + v * s.by, s.z + u * s.az + v * s.bz, s.nx, s.ny, s.nz
    turn = (u - 0.5) * 2 * pi
    if s.kind == CYLINDER:
        return s.x + s.ax * sin(turn), s.y - (1 - v) * s.bx, s.z + s.ax * cos(turn), sin(turn), 0.0, cos(turn)
    nx, ny, nz = sin(v * pi) * sin(turn), -cos(v * pi), sin(v * pi) * cos(turn)
    return s.x + s.ax * nx, s.y + s.ax * ny, s.z + s.ax * nz, nx, ny, nz


@compiled
def hit_flat(s: Any, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, far: float) -> Any:
    """Distance to a quad or disc and position on it: t, u, v; t = far for a miss. Both sides are hit."""
    slope = s.nx * dx + s.ny * dy + s.nz * dz
    if abs(slope) < 1e-12:
        return far, 0.0, 0.0
    t = (s.nx * (s.x - ox) + s.ny * (s.y - oy) + s.nz * (s.z - oz)) / slope
    if t <= 0 or t >= far:
        return far, 0.0, 0.0
    x, y, z = ox + t * dx - s.x, oy + t * dy - s.y, oz + t * dz - s.z
    u = (x * s.ax + y * s.ay + z * s.az) / (s.ax * s.ax + s.ay * s.ay + s.az * s.az)
    v = (x * s.bx + y * s.by + z * s.bz) / (s.bx * s.bx + s.by * s.by + s.bz * s.bz)
    outside = u < 0 or u > 1 or v < 0 or v > 1
    if s.kind == DISC:
        outside = (u - 0.5) * (u - 0.5) + (v - 0.5) * (v - 0.5) > 0.25
    return (far, 0.0, 0.0) if outside else (t, u, v)


@compiled
def hit_round(s: Any, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, far: float) -> Any:
    """As `hit_flat`, for a sphere or an upright cylinder's side."""
    upright, radius, height = s.kind == CYLINDER, s.ax, s.bx
    x, y, z = ox - s.x, oy - s.y, oz - s.z
    bend = 0.0 if upright else 1.0
    qa = dx * dx + bend * dy * dy + dz * dz
    qb = x * dx + bend * y * dy + z * dz
    root = qb * qb - qa * (x * x + bend * y * y + z * z - radius * radius)
    if root < 0 or qa < 1e-12:
        return far, 0.0, 0.0
    root = sqrt(root)
    for sign in (-1.0, 1.0):
        t = (-qb + sign * root) / qa
        if t <= 0 or t >= far:
            continue
        hx, hy, hz = (x + t * dx) / radius, y + t * dy, (z + t * dz) / radius
        if not upright:
            u, v = sphere_uv(hx, hy / radius, hz)
            return t, u, v
        if -height <= hy <= 0:
            return t, atan2(hx, hz) / (2 * pi) + 0.5, 1 + hy / height
    return far, 0.0, 0.0


@compiled
def nearest(
    surfaces: np.ndarray, groups: np.ndarray,
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, far: float,
) -> Any:  # fmt: skip
    """The first surface along a ray: index (-1 if none is closer than far), t, u, v."""
    found, best_u, best_v = -1, 0.0, 0.0
    ix, iy, iz = 1 / (dx + 1e-15), 1 / (dy + 1e-15), 1 / (dz + 1e-15)
    for k in range(len(groups)):
        g = groups[k]
        ax, bx = (g.low_x - ox) * ix, (g.high_x - ox) * ix
        ay, by = (g.low_y - oy) * iy, (g.high_y - oy) * iy
        az, bz = (g.low_z - oz) * iz, (g.high_z - oz) * iz
        enter = max(min(ax, bx), min(ay, by), min(az, bz))
        leave = min(max(ax, bx), max(ay, by), max(az, bz))
        if enter > leave or leave < 0 or enter >= far:
            continue
        for i in range(g.first, g.end):
            s = surfaces[i]
            if s.kind <= DISC:
                t, u, v = hit_flat(s, ox, oy, oz, dx, dy, dz, far)
            else:
                t, u, v = hit_round(s, ox, oy, oz, dx, dy, dz, far)
            if t < far:
                found, far, best_u, best_v = i, t, u, v
    return found, far, best_u, best_v
