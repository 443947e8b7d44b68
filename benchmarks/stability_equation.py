"""The dial's equation against mpmath at 50 digits.

Inputs are random over all magnitudes and rounded to their dtype; the reference is of exactly these
numbers. Errors are relative, in units of the eps of the dtype. Results below the smallest normal
number may be off by that number.
"""

import math

from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import LOG_GROWTH_MAX, SIGMA_MAX, attenuate
from common import Table

import mpmath
import numpy as np
import torch
from mpmath import mpf

mpmath.mp.dps = 50
DTYPES = {"float64": torch.float64, "float32": torch.float32}
DIALS = (1.0, math.sqrt(3), 7.0, 100.0, 1e4)
POINTS = 2000  # of each dial value
EXACT = 2.0**-52  # eps of float64, in which fades are computed
OF_OPACITY = "2; float64: + 1 / (1 - t)"
BOUNDS = {
    "drawn opacity": OF_OPACITY,
    "its gradient by logit, relative to it": OF_OPACITY,
    "its gradient by sigma_d": "6",
    "growth": "4 + 2 abs(h) (1 + log m)",
    "its gradient by growth_d": "4 + 2 abs(h) (1 + log m) + 2 / log m",
}


class Tally:
    """Errors of the quantities in one dtype."""

    def __init__(self, dtype):
        self.dtype = dtype
        self.info = torch.finfo(DTYPES[dtype])
        self.rows = {}

    def add(self, name, got, want, allowed, scale=None):
        """Counts the error of a number, relative to it or to ``scale``."""
        row = self.rows.setdefault(
            name,
            {
                "quantity": name,
                "dtype": self.dtype,
                "bound": BOUNDS[name],
                "points": 0,
                "nan": 0,
                "failed": 0,
                "worst": 0.0,
                "worst_of_bound": 0.0,
            },
        )
        size = abs(want if scale is None else scale)
        off = abs(mpf(got) - want)
        if off <= self.info.tiny:
            error = 0.0
        else:
            error = float(off / (self.info.eps * size)) if size and math.isfinite(got) else math.inf
        row["points"] += 1
        row["nan"] += math.isnan(got)
        row["failed"] += not error <= allowed
        row["worst"] = max(row["worst"], error)
        row["worst_of_bound"] = max(row["worst_of_bound"], error / allowed)


def measure():
    rows = []
    for dtype in DTYPES:
        tally = Tally(dtype)
        for k, s in enumerate(DIALS):
            check_opacities(tally, np.random.default_rng(k), s)
            check_growth(tally, np.random.default_rng(k), s)
        rows += tally.rows.values()
    return rows


def rounded(dtype, values):
    return torch.tensor(values).to(DTYPES[dtype])


def some_of(random, *columns):
    """Each number from one of the columns."""
    return np.choose(random.integers(len(columns), size=POINTS), columns)


def check_opacities(tally, random, s):
    """Drawn opacities and gradients, from far inside the reach to just beyond it; what is culled
    must be 0.
    """
    logits = some_of(random, random.uniform(-80, 80, POINTS), random.uniform(-12, 12, POINTS))
    logits = rounded(tally.dtype, logits)
    sigma = some_of(random, 10.0 ** random.uniform(-12, 9, POINTS), np.full(POINTS, SIGMA_MAX))
    sigma = rounded(tally.dtype, sigma)
    near = 10.0 ** random.uniform(-7, 0, POINTS)
    d = rounded(tally.dtype, sigma.double().numpy() / s * some_of(random, near, 1 - near, 1 + near))
    leaves = (logits.requires_grad_(), sigma.requires_grad_())
    drawn = attenuate(*leaves, d, s, AttenuationConfig()).drawn
    slopes = torch.autograd.grad(drawn.sum(), leaves)
    columns = (column.detach().tolist() for column in (*leaves, d, drawn, *slopes))
    for logit, reach, distance, opacity, by_logit, by_sigma in zip(*columns, strict=True):
        t = mpf(distance) * mpf(s) / mpf(reach)
        if abs(t - 1) < EXACT:
            continue  # both answers are right
        a = 1 / (1 + mpmath.exp(-mpf(logit)))
        allowed = 2 + EXACT / tally.info.eps / max(float(1 - t), EXACT)
        want = a * (1 - t**4) if t < 1 else mpf(0)
        slope = want * (1 - a)
        tally.add("drawn opacity", opacity, want, allowed)
        tally.add("its gradient by logit, relative to it", by_logit, slope, allowed, scale=want)
        slope = 4 * a * t**4 / mpf(reach) if t < 1 else mpf(0)
        tally.add("its gradient by sigma_d", by_sigma, slope, 6)


def check_growth(tally, random, s):
    exponents = some_of(random, random.uniform(-1, 3, POINTS), random.uniform(-20, 20, POINTS))
    h = rounded(tally.dtype, exponents)
    d = rounded(tally.dtype, 10.0 ** random.uniform(-2, 4, POINTS))
    zero = torch.zeros_like(h)
    r = 0.3
    config = AttenuationConfig(reference_distance=r)
    got = attenuate(zero, zero, d, s, config, growth_d=h.requires_grad_()).growth
    (slope,) = torch.autograd.grad(got.sum(), h)
    columns = (column.tolist() for column in (h, d, got, slope))
    for exp, dist, grown, steep in zip(*columns, strict=True):
        log_m = max(mpmath.log(mpf(dist) * mpf(s) / mpf(r)), mpf(0))
        log_g, allowed = mpf(exp) * log_m, 4 + 2 * abs(exp) * (1 + float(log_m))
        if abs(abs(log_g) - LOG_GROWTH_MAX) > tally.info.eps * allowed:
            inside = abs(log_g) < LOG_GROWTH_MAX
            want = mpmath.exp(log_g if inside else mpmath.sign(log_g) * LOG_GROWTH_MAX)
            tally.add("growth", grown, want, allowed)
            allowed += 2 / max(float(log_m), 1e-300)
            tally.add("its gradient by growth_d", steep, want * log_m * inside, allowed)


def page_table(rows):
    """Worst errors and shares of the bounds."""
    lines = {name: [name, bound] for name, bound in BOUNDS.items()}
    for row in rows:
        lines[row["quantity"]].append(f"{row['worst']:.2g} ({row['worst_of_bound']:.0%})")
    return Table(["", "bound", *DTYPES], lines.values(), rows, 2)
