"""The dial's equation and the paper's formula against mpmath at 50 digits.

Inputs are random over all magnitudes and rounded to their dtype; the reference is of exactly these numbers. Errors are
in units of the eps of the dtype. Results below the smallest normal number may be off by that number. The paper's
formula is computed as it stands, in the inputs' dtype. It fails where it is NaN, infinite, 0 in place of a normal
number, or off by more than 1,000 eps.
"""

import math
from collections.abc import Callable
from typing import Any

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import LOG_GROWTH_MAX, SIGMA_MAX, attenuate
from clod_adapter.equation.extinction import extinction_scale, sigma_for_extinction
from common import table

import mpmath
import numpy as np
import torch
from mpmath import mpf
from torch import Tensor

mpmath.mp.dps = 50
DTYPES = {"float64": torch.float64, "float32": torch.float32}
DIALS = [(s, tau, eps) for s in (1.0, math.sqrt(3), 7.0, 100.0, 1e4) for tau in (1e-6, 0.02, 0.5) for eps in (0, 1e-8)]
POINTS = 600  # of each dial value
BOUNDS = {
    "log opacity": "4", "opacity": "4; float64: + 3u", "gradient of log opacity by sigma_d": "4",
    "gradient of opacity by logit": "4; float64: + 3u", "drawn, soft threshold": "6 + 5 (abs(log tau s) + 1) / x; "
    "float64: + 3u", "growth": "4 + 2 abs(h) (1 + log m)",
    "gradient of growth by growth_d": "4 + 2 abs(h) (1 + log m) + 2 / log m", "extinction scale": "6 + abs(log a)",
    "inverse of the extinction scale, squared": "4; float64: + (abs(log a) + abs(log tau s*) + 1) / log(a / tau s*)",
}  # fmt: skip


class Tally:
    """Errors of the quantities in one dtype."""

    def __init__(self, dtype: str) -> None:
        self.dtype, self.info, self.rows = dtype, torch.finfo(DTYPES[dtype]), dict[str, dict[str, Any]]()

    def add(self, name: str, got: float, want: Any, allowed: float, naive: float | None = None) -> None:
        row = self.rows.setdefault(name, {
            "part": "equation", "quantity": name, "dtype": self.dtype, "bound": BOUNDS[name], "points": 0, "nan": 0,
            "failed": 0, "worst": 0.0, "worst_of_bound": 0.0, "naive_failed": 0,
        })  # fmt: skip
        size, normal = abs(want), self.info.tiny <= abs(want) <= self.info.max
        if normal:
            error = float(abs(mpf(got) - want) / (self.info.eps * size)) if math.isfinite(got) else math.inf
        elif size > self.info.max:
            error = 0.0 if math.isinf(got) or got == 0 else math.inf
        else:
            error = 0.0 if abs(mpf(got) - want) <= self.info.tiny else math.inf
        row["points"] += 1
        row["nan"] += math.isnan(got)
        row["failed"] += not error <= allowed
        row["worst"], row["worst_of_bound"] = max(row["worst"], error), max(row["worst_of_bound"], error / allowed)
        if naive is not None and normal:
            bad = not math.isfinite(naive) or abs(mpf(naive) - want) > 1000 * self.info.eps * size
            row["naive_failed"] += bad


def measure() -> list[dict[str, Any]]:
    tallies = [Tally(dtype) for dtype in DTYPES]
    for tally in tallies:
        for k, (s, tau, eps) in enumerate(DIALS):
            check_opacities(tally, np.random.default_rng(k), s, tau, eps)
            check_extinction(tally, np.random.default_rng(k), tau, eps)
            check_growth(tally, np.random.default_rng(k), s)
    return [row for tally in tallies for row in tally.rows.values()]


def drawn_of(random: np.random.Generator, dtype: str, *makers: Callable[[int], Any]) -> list[Tensor]:
    """A column for each maker, rounded to the dtype."""
    limit = torch.finfo(DTYPES[dtype]).max
    return [torch.tensor(np.asarray(make(POINTS))).clamp(-limit, limit).to(DTYPES[dtype]) for make in makers]


def logits_of(random: np.random.Generator) -> Callable[[int], Any]:
    return lambda n: np.where(random.random(n) < 0.2, random.uniform(-200, 200, n), random.uniform(-12, 12, n))


def sigmas_of(random: np.random.Generator) -> Callable[[int], Any]:
    ends = [-1.0, 0.0, 1e-12, 1e12, SIGMA_MAX]
    return lambda n: np.concatenate([ends, 10.0 ** random.uniform(-12, 12, n // 3), 10.0 ** random.uniform(-3, 4, n)])[
        random.permutation(n)
    ]


def log_sigmoid(logit: float) -> Any:
    return -mpmath.log1p(mpmath.exp(-mpf(logit)))


def exponent(sigma: float, d: float, s: float, eps: float) -> tuple[Any, Any]:
    """u, and the slope of log a'' by sigma_d."""
    positive = max(mpf(sigma), mpf(0))
    v = positive**2 + mpf(eps) / 2
    if d == 0 or v == 0:
        return (mpf(0) if d == 0 else mpmath.inf), mpf(0)
    u = (mpf(d) * mpf(s)) ** 2 / (2 * v)
    return u, 2 * u * positive / v


def check_opacities(tally: Tally, random: np.random.Generator, s: float, tau: float, eps: float) -> None:
    """Attenuated and drawn opacities, and gradients. x is ``log(a'' / tau s)``; points within its rounding are not
    compared."""
    wide = tally.dtype == "float64"
    logits, sigma, d = drawn_of(
        random, tally.dtype, logits_of(random), sigmas_of(random), lambda n: random.uniform(0, 1.05, n)
    )
    logits.requires_grad_(), sigma.requires_grad_()
    out = attenuate(logits, sigma, d, s, AttenuationConfig(tau=tau, eps=eps, max_sv=1))
    naive = logits.sigmoid() * (-((d * s) ** 2) / (2 * sigma.relu() ** 2 + eps)).exp()
    (by_logit,) = torch.autograd.grad(out.opacities.sum(), logits, retain_graph=True)
    (log_by_sigma,) = torch.autograd.grad(out.log_opacities.sum(), sigma, retain_graph=True)
    (naive_by_sigma,) = torch.autograd.grad(naive.log().sum(), sigma)
    columns = (logits, sigma, d, out.log_opacities, out.opacities, log_by_sigma, by_logit, out.drawn, naive,
               naive.log(), naive_by_sigma)  # fmt: skip
    level, logs = mpmath.log(mpf(tau) * mpf(s)), abs(math.log(tau * s)) + 1
    for x, sig, dist, log, a, slope, faint, shown, plain, plain_log, plain_slope in zip(
        *(column.detach().tolist() for column in columns), strict=True
    ):
        log_a, (u, steep) = log_sigmoid(x), exponent(sig, dist, s, eps)
        if u == mpmath.inf:
            continue
        soft = 4.0 + (3 * min(float(u), 1e9) if wide else 0)
        opacity = mpmath.exp(log_a - u) if u < 11000 else mpf(0)
        tally.add("log opacity", log, log_a - u, 4, plain_log)
        tally.add("opacity", a, opacity, soft, plain)
        tally.add("gradient of log opacity by sigma_d", slope, steep, 4, plain_slope)
        tally.add("gradient of opacity by logit", faint, opacity / (1 + mpmath.exp(mpf(x))), soft)
        above, margin = log_a - u - level, 4 * tally.info.eps * logs
        if abs(above) > margin:
            share = min(max(2 * mpmath.expm1(min(above, mpf(1))), mpf(0)), mpf(1))
            fading = 0 < above < math.log(1.5) + margin
            tally.add("drawn, soft threshold", shown, opacity * share, soft + (2 + 5 * logs / float(above)) * fading)


def check_extinction(tally: Tally, random: np.random.Generator, tau: float, eps: float) -> None:
    """s*, the root of ``log(s tau / a) + (d s)^2 / 2v``; and the sigma_d for a wanted s*, by its square."""
    wide, double = tally.dtype == "float64", np.finfo(float).eps
    logits, sigma, d, wish = drawn_of(
        random, tally.dtype, logits_of(random), sigmas_of(random), lambda n: random.uniform(0, 1.05, n),
        lambda n: 10.0 ** random.uniform(-2, 4, n),
    )  # fmt: skip
    config = AttenuationConfig(tau=tau, eps=eps, max_sv=1)
    found = extinction_scale(logits, sigma, d, config), sigma_for_extinction(logits, d, wish, config)
    for x, sig, dist, s, got, back in zip(*(c.tolist() for c in (logits, sigma, d, wish, *found)), strict=True):
        log_a, (unit, _) = log_sigmoid(x), exponent(sig, dist, 1.0, eps)
        upper = mpmath.exp(log_a) / mpf(tau)
        if unit != mpmath.inf and mpmath.exp(log_a) >= tally.info.tiny:
            root = upper * mpmath.exp(-mpmath.lambertw(2 * unit * upper**2).real / 2) if unit > 0 else upper
            tally.add("extinction scale", got, root, 6 + abs(float(log_a)))
        level = mpmath.log(mpf(tau) * mpf(s))
        drop, logs = log_a - level, abs(float(log_a)) + abs(float(level)) + 1
        if abs(drop) > 4 * double * logs and drop > 0 and dist > 0:
            total = (mpf(dist) * mpf(s)) ** 2 / (2 * drop)
            want = min(mpmath.sqrt(max(total - mpf(eps) / 2, mpf(0))), mpf(SIGMA_MAX))
            scale = max(total, mpf(eps) / 2)
            allowed = 4 + double / tally.info.eps * logs / float(drop)
            moved = 1 + (mpf(back) ** 2 - want**2) / scale if want < SIGMA_MAX else mpf(1)
            name = "inverse of the extinction scale, squared"
            tally.add(name, float(moved), mpf(1), allowed if wide else allowed + 1)


def check_growth(tally: Tally, random: np.random.Generator, s: float) -> None:
    h, d = drawn_of(random, tally.dtype, lambda n: np.where(random.random(n) < 0.8, random.uniform(-1, 3, n),
                    random.uniform(-20, 20, n)), lambda n: 10.0 ** random.uniform(-2, 4, n))  # fmt: skip
    zero, r = torch.zeros_like(h), 0.3
    leaf = h.clone().requires_grad_()
    config = AttenuationConfig(reference_distance=r, max_sv=1)
    got = attenuate(zero, zero, d, s, config, growth_d=leaf).growth
    (slope,) = torch.autograd.grad(got.sum(), leaf)
    for exp, dist, grown, steep in zip(h.tolist(), d.tolist(), got.tolist(), slope.tolist(), strict=True):
        log_m = max(mpmath.log(mpf(dist) * mpf(s) / mpf(r)), mpf(0))
        log_g, allowed = mpf(exp) * log_m, 4 + 2 * abs(exp) * (1 + float(log_m))
        if abs(abs(log_g) - LOG_GROWTH_MAX) > tally.info.eps * allowed:
            inside = abs(log_g) < LOG_GROWTH_MAX
            want = mpmath.exp(log_g if inside else mpmath.sign(log_g) * LOG_GROWTH_MAX)
            tally.add("growth", grown, want, allowed)
            allowed += 2 / max(float(log_m), 1e-300)
            tally.add("gradient of growth by growth_d", steep, want * log_m * inside, allowed)


def tables(rows: list[dict[str, Any]]) -> str:
    """Points; worst errors and shares of the bounds; shares of points at which the paper's formula fails."""
    points, nan, failed = (sum(row[key] for row in rows) for key in ("points", "nan", "failed"))
    lines = []
    for name, bound in BOUNDS.items():
        found = {row["dtype"]: row for row in rows if row["quantity"] == name}
        cells = [f"{found[d]['worst']:.2g} ({found[d]['worst_of_bound']:.0%})" for d in DTYPES]
        naive = found["float32"]["naive_failed"] / found["float32"]["points"]
        lines.append([name, bound, *cells, f"{naive:.1%}" if naive else ""])
    heads = ["", "bound", *DTYPES, "the paper's formula fails, float32"]
    return f"{points:,} points: {nan} NaN, {failed} past the bound\n\n{table(heads, lines, 2)}"
