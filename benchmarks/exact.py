"""The dial's equation at 50 digits, the points of comparison, and the paper's formula.

mpmath evaluates the functions of few inputs (log a, ``u = (d s)^2 / 2v`` and its exponential, the slope,
``log(tau s)``). numpy's long double combines them; its 64 bits are 2,000 times as fine as float64's.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from clod_adapter.equation.attenuation import SIGMA_MAX

import mpmath
import numpy as np
import torch
from mpmath import mpf
from scipy.special import lambertw
from torch import Tensor

mpmath.mp.dps = 50
Wide = np.longdouble
Array = np.ndarray
DTYPES = {name: getattr(torch, name) for name in ("float64", "float32", "bfloat16", "float16")}
LOGITS, SIGMAS, DISTANCES = 33, 48, 16  # how many of each; with 50 pairs of s and eps 1.3e6 points
SCALES = [1.0, 1.3, math.sqrt(3), math.pi, 7.0, 23.7, 100.0, 612.5, 3333.3, 1e4]
EPSILONS = [0.0, 1e-12, 1e-8, 3e-5, 1e-2]
TAUS = [1e-6, 1e-5, 3e-4, 1 / 255, 0.02, 0.1, 0.3, 0.5, 0.9, 0.999]  # s goes to 1e4: all but one are past 1/s there
REACHES = [1e-3, 0.3, 1.0, math.e, 400.0]  # of growth
TEMPERATURES = [1e-300, 1e-30, 1e-6, 1e-3, 0.02, 0.15, 0.5, 1.0, 10.0, 1e6]


class Case(NamedTuple):
    """Gaussians at one dial value: columns of inputs, and of mpmath's results."""

    logits: Array
    sigma: Array
    d: Array
    log_a: Array
    faint: Array  # 1 - a
    u: Array
    factor: Array  # e^-u
    slope: Array  # of log a'' by sigma
    s: float
    tau: float
    eps: float


def computed_in(dtype: str) -> str:
    """Half-precision inputs are computed in float32."""
    return "float64" if dtype == "float64" else "float32"


def wide(values: list[Any]) -> Array:
    """mpmath's numbers in long double, rounded to 64 bits."""
    out = np.empty(len(values), Wide)
    for i, value in enumerate(values):
        if not mpmath.isfinite(value):
            out[i] = float(value)
            continue
        fraction, exponent = mpmath.frexp(value)
        high = float(fraction)
        out[i] = np.ldexp(Wide(high) + Wide(float(fraction - high)), max(-16000, min(int(exponent), 16000)))
    return out


def rounded(values: Any, dtype: str) -> Array:
    """Float64 numbers that the dtype has; those past its range are its largest."""
    limit = torch.finfo(DTYPES[dtype]).max
    return torch.tensor(np.asarray(values)).clamp(-limit, limit).to(DTYPES[dtype]).double().numpy()


def tensor(values: Array, dtype: str, grad: bool = False) -> Tensor:
    return torch.tensor(values).to(DTYPES[dtype]).requires_grad_(grad)


def plain(value: Tensor) -> Array:
    return value.detach().double().numpy()


def columns(*axes: Array) -> list[Array]:
    """The axes' product, a column each."""
    return [column.ravel() for column in np.meshgrid(*axes, indexing="ij")]


def axes_of(dtype: str) -> tuple[Array, Array, Array]:
    """Logits, sigma_d and distances: the ends of their ranges, and random ones between."""
    random = np.random.default_rng(0)
    logits = [-200, -90, -40, 0, 17, 40, 90, 200]
    sigmas = [-1, -1e-12, 0, 1e-12, 1e12, SIGMA_MAX, *10.0 ** random.uniform(-12, 12, 14)]
    distances = [0, 1e-6, 1e-3, 0.5, 1, 1 + 1e-7, 1.05]
    logits += [*random.uniform(-12, 12, LOGITS - len(logits) - 2)]
    sigmas += [*10.0 ** random.uniform(-3, 4, SIGMAS - len(sigmas))]
    distances += [*random.uniform(0, 1, DISTANCES - len(distances))]
    return np.append(rounded(logits, dtype), [-np.inf, np.inf]), rounded(sigmas, dtype), rounded(distances, dtype)


def log_sigmoid(logit: float) -> Any:
    """log a."""
    return mpf(logit) if logit == -math.inf else -mpmath.log1p(mpmath.exp(-mpf(logit)))


def log_threshold(tau: float, s: float) -> Any:
    """``log(tau s)``; -inf for s = 0, a wish that ``sigma_for_extinction`` takes."""
    return mpmath.log(mpf(tau) * mpf(s)) if s > 0 else -mpmath.inf


def decay(sigma: float, d: float, s: float, eps: float) -> tuple[Any, Any]:
    """u, and the slope of log a'' by sigma."""
    positive = max(mpf(sigma), mpf(0))
    v = positive**2 + mpf(eps) / 2
    if d == 0 or v == 0:
        return (mpf(0) if d == 0 else mpmath.inf), mpf(0)
    u = (mpf(d) * mpf(s)) ** 2 / (2 * v)
    return u, 2 * u * positive / v


def exponential(u: Any) -> Any:
    """e^-u; past long double's range 0."""
    return mpmath.exp(-u) if u < 11000 else mpf(0)


def grid(dtype: str) -> Iterator[Case]:
    """Every logit, sigma_d and distance at every s and eps; tau goes round."""
    logits, sigmas, distances = axes_of(dtype)
    log_a, faint = (wide([value(x) for x in logits]) for value in (log_sigmoid, lambda x: 1 / (1 + mpmath.exp(mpf(x)))))
    pairs = list(itertools.product(sigmas, distances))
    for i, (s, eps) in enumerate(itertools.product(SCALES, EPSILONS)):
        found = [decay(*pair, s, eps) for pair in pairs]
        parts = [u for u, _ in found], [exponential(u) for u, _ in found], [slope for _, slope in found]
        yield Case(
            *columns(logits, sigmas, distances), *(np.repeat(x, len(pairs)) for x in (log_a, faint)),
            *(np.tile(wide(part), len(logits)) for part in parts), s, TAUS[i * 3 % len(TAUS)], eps,
        )  # fmt: skip


def at_the_threshold(dtype: str) -> Iterator[Case]:
    """Logits that put a'' at ``tau s e^x``, x from 1e-7 to 1 on either side, as near as the dtype allows."""
    random = np.random.default_rng(1)
    offsets = np.concatenate([sign * 10.0 ** np.linspace(-7, 0, 32) for sign in (1, -1)])
    dials = [(1.0, 0.02, 1e-8), (2.3, 0.02, 1e-8), (5.0, 1 / 255, 0.0), (100.0, 1e-4, 1e-2), (1e4, 1e-6, 0.0)]
    for s, tau, eps in dials:
        sigmas, distances = s * 10.0 ** random.uniform(-0.3, 1, 8), random.uniform(0, 1.05, 8)
        sigma, d, x = columns(rounded(sigmas, dtype), rounded(distances, dtype), offsets)
        u, slope = zip(*(decay(*pair, s, eps) for pair in zip(sigma, d, strict=True)), strict=True)
        log_a = np.minimum(np.log(tau * s) + x + np.array(u, float), -1e-9)
        logits = rounded(log_a - np.log(-np.expm1(log_a)), dtype)
        logs = [log_sigmoid(logit) for logit in logits]
        parts = logs, [-mpmath.expm1(log) for log in logs], u, [exponential(value) for value in u], slope
        yield Case(logits, sigma, d, *(wide(list(part)) for part in parts), s, tau, eps)


def growth_axes(dtype: str) -> tuple[Array, Array]:
    """Exponents and distances: the ends of their ranges, trained ones, and random ones between."""
    random = np.random.default_rng(5)
    exponents = [-20, -1, 0, 1e-6, 3, 20, *random.uniform(-1, 3, 21), *random.uniform(-20, 20, 5)]
    distances = [0, 1e-6, 1e-3, 0.3, 1, 1 + 1e-7, 400, 1e4, *10.0 ** random.uniform(-2, 3, 24)]
    return rounded(exponents, dtype), rounded(distances, dtype)


def log_magnification(d: float, s: float, r: float) -> Any:
    """log m of growth."""
    return max(mpmath.log(mpf(d) * mpf(s) / mpf(r)), mpf(0)) if d > 0 else mpf(0)


def newton(at: Array, unit: Array, upper: Array) -> Array:
    """The extinction scale, by a step from ``at`` towards the root of ``log(s / upper) + unit s^2``, in log s.

    Off by the square of ``at``'s relative error. ``unit`` is u at s = 1, ``upper`` a/tau.
    """
    with np.errstate(all="ignore"):
        u = unit * Wide(at) ** 2
        root = at / (1 + (np.log(at / upper) + u) / (1 + 2 * u))
    return np.where(np.isinf(unit), 0, np.where((at > 0) & (upper > 0), root, upper))


def naive_opacities(logits: Tensor, sigma: Tensor, d: Tensor, s: float, eps: float) -> tuple[Tensor, Tensor]:
    """The paper's Eq. 2 as it stands: the exponent, and a''."""
    exponent = -((d * s) ** 2) / (2 * sigma.relu() ** 2 + eps)
    return exponent, logits.sigmoid() * exponent.exp()


def naive_extinction(logits: Tensor, sigma: Tensor, d: Tensor, tau: float, eps: float) -> Tensor:
    """The closed form as it stands, with scipy's W."""
    variance, a = sigma.relu() ** 2 + eps / 2, logits.sigmoid()
    w = lambertw(plain((a * d / tau) ** 2 / variance)).real
    return (variance / d**2 * torch.tensor(w).to(d.dtype)).sqrt()


def naive_inverse(logits: Tensor, d: Tensor, wish: Tensor, tau: float, eps: float) -> Tensor:
    """Its inverse as it stands."""
    return ((d * wish) ** 2 / (2 * (logits.sigmoid() / (tau * wish)).log()) - eps / 2).clamp(min=0).sqrt()


def naive_slope(logits: Tensor, log_opacities: Tensor, soft: Tensor, temperature: float) -> Tensor:
    """``count_slope`` as it stands; ``soft`` is its q."""
    u = logits.sigmoid().log() - log_opacities
    return soft * (1 - soft) / (temperature * len(u)) * (2 * u).clamp(min=1)
