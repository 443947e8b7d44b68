"""COLMAP's perspective lenses in plain numpy: where a lens shows a direction.

``(u, v)`` are coordinates on the plane z = 1 before the lens, ``f (u', v') + c`` pixels after it, centres at +0.5.

Source: COLMAP, ``src/colmap/sensor/models.h``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

Plane = tuple[np.ndarray, np.ndarray]
Distortion = Callable[[np.ndarray, np.ndarray, Sequence[float]], Plane]


def _polynomial(x: np.ndarray, coefficients: Sequence[float]) -> np.ndarray:
    """``k1 x + k2 x^2 + ...``"""
    return np.polyval([*reversed(coefficients), 0.0], x)


def _tangential(u: np.ndarray, v: np.ndarray, p1: float, p2: float) -> Plane:
    return 2 * p1 * u * v + p2 * (3 * u * u + v * v), 2 * p2 * u * v + p1 * (u * u + 3 * v * v)


def _radial(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    factor = 1 + _polynomial(u * u + v * v, k)
    return u * factor, v * factor


def _opencv(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    k1, k2, p1, p2 = k
    (x, y), (dx, dy) = _radial(u, v, (k1, k2)), _tangential(u, v, p1, p2)
    return x + dx, y + dy


def _full_opencv(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    r2 = u * u + v * v
    factor = (1 + _polynomial(r2, (k1, k2, k3))) / (1 + _polynomial(r2, (k4, k5, k6)))
    dx, dy = _tangential(u, v, p1, p2)
    return u * factor + dx, v * factor + dy


def _fisheye(u: np.ndarray, v: np.ndarray) -> Plane:
    """The directions with their angle to the axis for a radius."""
    r = np.hypot(u, v)
    factor = np.divide(np.arctan(r), r, out=np.ones_like(r), where=r > 1e-12)
    return u * factor, v * factor


def _fisheye_radial(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    return _radial(*_fisheye(u, v), k)


def _thin_prism(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    k1, k2, p1, p2, k3, k4, sx, sy = k
    u, v = _fisheye(u, v)
    r2 = u * u + v * v
    (x, y), (dx, dy) = _radial(u, v, (k1, k2, k3, k4)), _tangential(u, v, p1, p2)
    return x + dx + sx * r2, y + dy + sy * r2


def _rad_tan_thin_prism(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    x, y = _fisheye_radial(u, v, k[:6])
    r2, (p0, p1, s0, s1, s2, s3) = x * x + y * y, k[6:]
    dx, dy = _tangential(x, y, p1, p0)
    return x + dx + s0 * r2 + s1 * r2 * r2, y + dy + s2 * r2 + s3 * r2 * r2


def _fov(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    r, omega = np.hypot(u, v), k[0]
    if abs(omega) < 1e-6:
        return u, v
    slope = 2 * np.tan(omega / 2)
    factor = np.divide(np.arctan(r * slope), r * omega, out=np.full_like(r, slope / omega), where=r > 1e-12)
    return u * factor, v * factor


def _division(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    with np.errstate(invalid="ignore"):  # NaN: the lens shows nothing from there
        factor = 2 / (1 + np.sqrt(1 - 4 * k[0] * (u * u + v * v)))
    return u * factor, v * factor


def _eucm(u: np.ndarray, v: np.ndarray, k: Sequence[float]) -> Plane:
    alpha, beta = k
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = 1 / (alpha * np.sqrt(beta * (u * u + v * v) + 1) + 1 - alpha)
    return u * factor, v * factor


@dataclass(frozen=True)
class LensModel:
    """How many of a model's parameters there are, and how many of the first are focal lengths; two centres follow."""

    parameters: int
    focals: int
    distort: Distortion = lambda u, v, k: (u, v)
    fisheye: bool = False
    undistorted: bool | None = None  # None: where all coefficients are 0


MODELS = {  # in the order of COLMAP's numbers
    "SIMPLE_PINHOLE": LensModel(3, 1),
    "PINHOLE": LensModel(4, 2),
    "SIMPLE_RADIAL": LensModel(4, 1, _radial),
    "RADIAL": LensModel(5, 1, _radial),
    "OPENCV": LensModel(8, 2, _opencv),
    "OPENCV_FISHEYE": LensModel(8, 2, _fisheye_radial, fisheye=True),
    "FULL_OPENCV": LensModel(12, 2, _full_opencv),
    "FOV": LensModel(5, 2, _fov, undistorted=False),
    "SIMPLE_RADIAL_FISHEYE": LensModel(4, 1, _fisheye_radial, fisheye=True),
    "RADIAL_FISHEYE": LensModel(5, 1, _fisheye_radial, fisheye=True),
    "THIN_PRISM_FISHEYE": LensModel(12, 2, _thin_prism, fisheye=True),
    "RAD_TAN_THIN_PRISM_FISHEYE": LensModel(16, 2, _rad_tan_thin_prism, fisheye=True),
    "SIMPLE_DIVISION": LensModel(4, 1, _division),
    "DIVISION": LensModel(5, 2, _division),
    "SIMPLE_FISHEYE": LensModel(3, 1, lambda u, v, k: _fisheye(u, v), fisheye=True),
    "FISHEYE": LensModel(4, 2, lambda u, v, k: _fisheye(u, v), fisheye=True),
    "EUCM": LensModel(6, 2, _eucm, undistorted=False),
    "EQUIRECTANGULAR": LensModel(2, 0),
}


@dataclass
class Lens:
    """A camera's model, size in pixels and parameters."""

    model_name: str
    width: int
    height: int
    params: np.ndarray

    @property
    def _model(self) -> LensModel:
        return MODELS[self.model_name]

    @property
    def focal_length_x(self) -> float:
        return float(self.params[0])

    @property
    def focal_length_y(self) -> float:
        return float(self.params[self._model.focals - 1])

    @property
    def center(self) -> np.ndarray:
        return self.params[self._model.focals : self._model.focals + 2]

    @property
    def coefficients(self) -> list[float]:
        return self.params[self._model.focals + 2 :].tolist()

    def is_perspective_fisheye(self) -> bool:
        return self._model.fisheye

    def is_perspective_pinhole(self) -> bool:
        return self._model.focals > 0 and not self._model.fisheye

    def is_undistorted(self) -> bool:
        known = self._model.undistorted
        return not any(self.coefficients) if known is None else known

    def calibration_matrix(self) -> np.ndarray:
        (cx, cy) = self.center
        return np.array([[self.focal_length_x, 0, cx], [0, self.focal_length_y, cy], [0, 0, 1.0]])

    def rescale(self, width: int, height: int) -> None:
        across, down = width / self.width, height / self.height
        focals = self._model.focals
        self.params = self.params.copy()
        self.params[:focals] *= (across, down) if focals == 2 else (across + down) / 2
        self.params[focals : focals + 2] *= (across, down)
        self.width, self.height = width, height

    def img_from_plane(self, points: np.ndarray) -> np.ndarray:
        """``[M, 2]`` pixels of points ``[M, 2]`` on the plane z = 1."""
        u, v = self._model.distort(points[:, 0], points[:, 1], self.coefficients)
        return np.column_stack([self.focal_length_x * u, self.focal_length_y * v]) + self.center

    def cam_from_img(self, pixels: np.ndarray) -> np.ndarray:
        """The inverse of ``img_from_plane``, by Newton's method with differences; NaN where it does not arrive."""
        target = (np.asarray(pixels, np.float64) - self.center) / (self.focal_length_x, self.focal_length_y)
        found, h, coefficients = target.copy(), 1e-6, self.coefficients

        def at(points: np.ndarray) -> np.ndarray:
            return np.column_stack(self._model.distort(points[:, 0], points[:, 1], coefficients))

        with np.errstate(all="ignore"):
            for _ in range(100):
                missing = at(found) - target
                columns = [(at(found + step) - at(found - step)) / (2 * h) for step in ([h, 0], [0, h])]
                (a, c), (b, d) = columns[0].T, columns[1].T
                step = np.column_stack([d * missing[:, 0] - b * missing[:, 1], a * missing[:, 1] - c * missing[:, 0]])
                found = found - step / (a * d - b * c)[:, None]
            arrived = np.abs(at(found) - target).max(axis=1) < 1e-6
        return np.where(arrived[:, None], found, np.nan)
