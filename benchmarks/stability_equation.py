"""The dial's equation and the paper's formula against mpmath at 50 digits.

Inputs are rounded to their dtype; the reference (exact.py) is of exactly these numbers. tau, s, epsilon and the
temperature are Python's floats. ``reference`` rows compare random points of the reference with mpmath alone.

Errors are in units of the eps of the result's dtype: float32's for half-precision inputs, which are computed in
float32, but the half's own for their gradients, which are rounded to it. Results below the smallest normal number may
be off by that number. The paper's formula is computed in the inputs' dtype. It fails where it is NaN, infinite, 0 in
place of a normal number, or off by more than 1,000 of that dtype's eps.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import exact
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import SIGMA_MAX, attenuate, log_attenuation
from clod_adapter.equation.extinction import extinction_scale, sigma_for_extinction
from clod_adapter.equation.growth import LOG_GROWTH_MAX
from clod_adapter.training.target_count import count_slope, soft_count
from common import table
from equation_tally import Tallies
from exact import DTYPES, Array, Case, Wide, plain, tensor, wide

import mpmath
import numpy as np
import torch
from mpmath import mpf
from torch import Tensor

COUNT_BOUND = "4 + (abs(log tau s) + 1) / 2T + 1.5 z"
FADE = math.log(1.5)  # log(a'' / tau s) above which the soft threshold changes nothing


def gradients(value: Tensor, *leaves: Tensor) -> list[Array]:
    return [plain(g) for g in torch.autograd.grad(value.sum(), leaves, retain_graph=True)]


def check_attenuation(tallies: Tallies, case: Case) -> None:
    """Log attenuation, of the case's first logit: it is the same for all."""
    one = slice(case.d.size // exact.LOGITS)
    where = {"sigma_d": case.sigma[one], "d": case.d[one], "s": case.s, "eps": case.eps}
    sigma, d = (tensor(where[name], tallies.dtype) for name in ("sigma_d", "d"))
    naive = plain(exact.naive_opacities(torch.zeros_like(d), sigma, d, case.s, case.eps)[0])
    got = plain(log_attenuation(sigma, d, case.s, case.eps))
    tallies.of("log attenuation", "4").add(got, -case.u[one], 4, where, naive)


def check_opacities(tallies: Tallies, case: Case) -> None:
    """Log a'', a'', and their gradients."""
    dtype, s, eps = tallies.dtype, case.s, case.eps
    d, logits, sigma = tensor(case.d, dtype), tensor(case.logits, dtype, True), tensor(case.sigma, dtype, True)
    out = attenuate(logits, sigma, d, s, AttenuationConfig(tau=case.tau, eps=eps, max_sv=1))
    naive = exact.naive_opacities(logits, sigma, d, s, eps)[1]
    by_logit, by_sigma = gradients(out.opacities, logits, sigma)
    log_by_logit, log_by_sigma = gradients(out.log_opacities, logits, sigma)
    naive_by_logit, naive_by_sigma = gradients(naive, logits, sigma)
    naive_log_by_logit, naive_log_by_sigma = gradients(naive.log(), logits, sigma)
    opacities = np.exp(case.log_a) * case.factor
    steep = np.where(opacities == 0, 0, opacities) * case.slope
    # exp makes u's error a relative one; where the results are float32's u is float64's until after it.
    soft, amplified = (4 + 3 * np.minimum(case.u, 1e9), "4 + 3u") if tallies.wide else (4.0, "4")
    where = {"logit": case.logits, "sigma_d": case.sigma, "d": case.d, "s": s, "eps": eps}
    # A gradient by sigma_d is a'' times a slope, which may be steep: as accurate as an a'' that is a normal number.
    normal = opacities >= tallies.info.tiny
    for name, bound, got, want, allowed, other, sure in [
        ("log opacity", "4", plain(out.log_opacities), case.log_a - case.u, 4, plain(naive.log()), True),
        ("opacity", amplified, plain(out.opacities), opacities, soft, plain(naive), True),
        ("gradient of log opacity by sigma_d", "4", log_by_sigma, case.slope, 4, naive_log_by_sigma, True),
        ("gradient of log opacity by logit", "4", log_by_logit, case.faint, 4, naive_log_by_logit, True),
        ("gradient of opacity by sigma_d", amplified, by_sigma, steep, soft, naive_by_sigma, normal),
        ("gradient of opacity by logit", amplified, by_logit, opacities * case.faint, soft, naive_by_logit, True),
    ]:
        tallies.of(name, bound, "gradient" in name).add(got, want, allowed, where, other, sure)


def check_drawn(tallies: Tallies, case: Case, place: str) -> None:
    """The drawn opacities of either threshold, and the soft one's gradient by sigma_d.

    By ``x = log(a'' / tau s)``, a difference of logarithms. Points within rounding of the threshold are not compared.
    """
    dtype, s, tau = tallies.dtype, case.s, case.tau
    level = wide([exact.log_threshold(tau, s)])[0]
    x = case.log_a - case.u - level
    logs = np.abs(level) + 1  # tau s is rounded before its logarithm is taken: the 1
    margin, more = 4 * tallies.info.eps * logs, " + 3u" if tallies.wide else ""
    steady = 4 + (3 * np.minimum(case.u, 1e9) if tallies.wide else np.zeros_like(case.u))
    faded = steady + np.where((x > 0) & (x < FADE + margin), 2 + 5 * logs / np.maximum(x, margin), 0)
    opacities, share = np.exp(case.log_a) * case.factor, np.clip(2 * np.expm1(np.minimum(x, 1)), 0, 1)
    fading = np.where((x > 0) & (x < FADE), share + 2, 0)  # f's slope
    steep = np.where(opacities == 0, 0, opacities) * case.slope * (share + fading)
    logits, d, sigma = tensor(case.logits, dtype), tensor(case.d, dtype), tensor(case.sigma, dtype, True)
    where = {"logit": case.logits, "sigma_d": case.sigma, "d": case.d, "s": s, "tau": tau, "eps": case.eps}
    a = exact.naive_opacities(logits, sigma, d, s, case.eps)[1]
    naive = {"hard": a * (a > tau * s), "soft": a * (2 * (a / (tau * s) - 1)).clamp(0, 1)}
    sure = np.abs(x) > margin
    for cut, want, allowed, bound in [
        ("hard", opacities * (x > 0), steady, "4"),
        ("soft", opacities * share, faded, "6 + 5 (abs(log tau s) + 1) / x, 4 above the fade"),
    ]:
        out = attenuate(logits, sigma, d, s, AttenuationConfig(tau=tau, eps=case.eps, cut=cut, max_sv=1))
        row = tallies.of(f"drawn, {cut} cut, {place}", bound + more)
        row.add(plain(out.drawn), want, allowed, where, plain(naive[cut]), sure)
    (by_sigma,), (other,) = gradients(out.drawn, sigma), gradients(naive["soft"], sigma)
    row = tallies.of(f"gradient of drawn by sigma_d, soft cut, {place}", "8 + 10 (abs(log tau s) + 1)" + more, True)
    row.add(by_sigma, steep, 4 + steady + 10 * logs, where, other, sure & (np.abs(x - FADE) > margin))


def check_growth(tallies: Tallies) -> None:
    """Growth and its gradient, which is not compared within rounding of the clamp and where it overflows."""
    dtype, info, axes = tallies.dtype, tallies.info, exact.growth_axes(tallies.dtype)
    h, d = exact.columns(*axes)
    zero = torch.zeros(len(h), dtype=DTYPES[dtype])
    largest = min(math.exp(LOG_GROWTH_MAX), torch.finfo(DTYPES[dtype]).max)
    for s, r in itertools.product(exact.SCALES, exact.REACHES):
        log_m = np.tile(wide([exact.log_magnification(x, s, r) for x in axes[1]]), len(axes[0]))
        log_g = Wide(h) * log_m
        want = np.exp(np.clip(log_g, -LOG_GROWTH_MAX, LOG_GROWTH_MAX))
        steep = np.where(np.abs(log_g) < LOG_GROWTH_MAX, want * log_m, 0)
        leaf, distance = tensor(h, dtype, True), tensor(d, dtype)
        config = AttenuationConfig(reference_distance=r, max_sv=1)
        got = attenuate(zero, zero, distance, s, config, growth_d=leaf).growth
        assert got is not None
        naive = ((distance * s / r).clamp(min=1) ** leaf).clamp(1 / largest, largest)
        allowed = 4 + 2 * np.abs(h) * (1 + log_m)
        sure = np.abs(np.abs(log_g) - LOG_GROWTH_MAX) > info.eps * allowed
        sure &= steep < torch.finfo(DTYPES[dtype]).max
        where = {"growth_d": h, "d": d, "s": s, "r": r}
        (slope,), (other,) = gradients(got, leaf), gradients(naive, leaf)
        bound = "4 + 2 abs(h) (1 + log m)"
        tallies.of("growth", bound).add(plain(got), want, allowed, where, plain(naive))
        row = tallies.of("gradient of growth by growth_d", bound + " + 2 / log m", True)
        row.add(slope, steep, allowed + 2 / np.maximum(log_m, 1e-300), where, other, sure)


def check_extinction(tallies: Tallies) -> None:
    """s*, by its Newton step from ``log(s / (a / tau)) + (d s)^2 / 2v = 0`` at the value found."""
    dtype = tallies.dtype
    logits, sigmas, distances = exact.axes_of(dtype)
    inputs = exact.columns(logits, sigmas, distances)
    log_a = np.repeat(wide([exact.log_sigmoid(x) for x in logits]), len(sigmas) * len(distances))
    condition = np.where(np.isfinite(log_a), 6 + np.abs(log_a), 6)
    sure = (np.exp(log_a) >= tallies.info.tiny) | ~np.isfinite(log_a)
    for eps in exact.EPSILONS:
        unit = wide([exact.decay(*pair, 1.0, eps)[0] for pair in itertools.product(sigmas, distances)])
        unit = np.tile(unit, len(logits))
        for tau in exact.TAUS:
            given = [tensor(x, dtype) for x in inputs]
            got = plain(extinction_scale(*given, AttenuationConfig(tau=tau, eps=eps, max_sv=1)))
            want = exact.newton(got, unit, np.exp(log_a - wide([exact.log_threshold(tau, 1)])[0]))
            where = dict(zip(("logit", "sigma_d", "d"), inputs, strict=True)) | {"tau": tau, "eps": eps}
            other = plain(exact.naive_extinction(*given, tau, eps))
            tallies.of("extinction scale", "6 + abs(log a)").add(got, want, condition, where, other, sure)


def check_inverse(tallies: Tallies) -> None:
    """sigma_d for a wanted s*, by the error of its square in units of the larger of v and eps/2."""
    dtype, info, double = tallies.dtype, tallies.info, np.finfo(float).eps
    logits, _, distances = exact.axes_of(dtype)
    between = 10.0 ** np.random.default_rng(2).uniform(-2, 4, exact.SIGMAS - 6)
    wishes = exact.rounded([0, 1e-6, 0.3, 1, 1.75, 1e4, *between], dtype)
    inputs = exact.columns(logits, distances, wishes)
    log_a = np.repeat(wide([exact.log_sigmoid(x) for x in logits]), len(distances) * len(wishes))
    bound = "4 + (abs(log a) + abs(log tau s*) + 1) / log(a / tau s*)" if tallies.wide else "4"
    for tau in exact.TAUS:
        level = np.tile(wide([exact.log_threshold(tau, s) for s in wishes]), len(logits) * len(distances))
        with np.errstate(all="ignore"):
            drop = log_a - level
            total = np.where(np.isinf(level), 0, (Wide(inputs[1]) * Wide(inputs[2])) ** 2 / (2 * drop))
            logs = np.where(np.isfinite(drop), np.abs(log_a) + np.abs(level) + 1, 0)
            allowed = 4 + np.where(logs > 0, double / info.eps * logs / np.abs(drop), 0)
        sure = ~(np.abs(drop) < 4 * double * logs)
        for eps in exact.EPSILONS:
            given = [tensor(x, dtype) for x in inputs]
            want = np.minimum(np.sqrt(np.maximum(total - Wide(eps) / 2, 0)), SIGMA_MAX)
            want = np.where(drop > 0, want, SIGMA_MAX)
            scale = np.where(drop > 0, np.maximum(total, eps / 2), Wide(SIGMA_MAX) ** 2)
            scale = np.where(scale > info.tiny, scale, 1)
            got = plain(sigma_for_extinction(*given, AttenuationConfig(tau=tau, eps=eps, max_sv=1)))
            other = np.where(drop > 0, plain(exact.naive_inverse(*given, tau, eps)), want)  # there is none beyond a/tau
            # Given to the tally as numbers around 1.
            moved, other = (1 + (Wide(x) ** 2 - want**2) / scale for x in (got, other))
            where = dict(zip(("logit", "d", "extinction"), inputs, strict=True)) | {"tau": tau, "eps": eps}
            row = tallies.of("inverse of the extinction scale, squared", bound)
            row.add(moved, np.ones_like(want), allowed, where, other, sure)


def check_counts(tallies: Tallies) -> None:
    """The slope of the soft count by log a'', and count_slope.

    Nothing is asked within the threshold's rounding, nor where q (1 - q) underflows.
    """
    dtype, info, random = tallies.dtype, tallies.info, np.random.default_rng(3)
    logit = exact.rounded(random.uniform(-200, 200, 1200), dtype)
    log_a = wide([exact.log_sigmoid(x) for x in logit])
    spread = np.append(-np.inf, exact.rounded([-200, 0, *-(10.0 ** random.uniform(-8, 2.3, 1157))], dtype))
    for s, tau, t in itertools.product(exact.SCALES, exact.TAUS, exact.TEMPERATURES):
        level = wide([exact.log_threshold(tau, s)])[0]
        near = level * (1 + 10.0 ** random.uniform(-8, 0, 40) * random.choice([-1, 1], 40))
        logs = np.append(spread, exact.rounded(np.minimum(near, 0).astype(float), dtype))
        leaf = tensor(logs, dtype, True)
        soft = ((leaf - math.log(tau * s)) / t).sigmoid()
        with np.errstate(all="ignore"):
            z, u = np.abs(logs - level) / Wide(t), log_a - logs
            want = np.exp(-z) / (1 + np.exp(-z)) ** 2 / (Wide(t) * len(logs))
            # The error of z, of whose exponential q (1 - q) is made; infinite where z is.
            allowed = 4 + np.expm1(info.eps * np.minimum((abs(level) + 1) / (2 * t) + 1.5 * z, 1e9)) / info.eps
            touched = np.where(np.isfinite(logs), np.maximum(2 * u, 1), 1)
        sure = (np.abs(logs - level) >= info.eps * (2 * np.abs(level) + 1)) & ((z < -math.log(info.tiny)) | (z > 1e4))
        where = {"log_opacity": logs, "s": s, "tau": tau, "temperature": t}
        got, other = gradients(soft_count(leaf, s, tau, t), leaf)[0], gradients(soft.mean(), leaf)[0]
        tallies.of("gradient of soft_count", COUNT_BOUND, True).add(got, want, allowed, where, other, sure)
        got = plain(count_slope(tensor(logit, dtype), leaf, s, tau, t))
        other = plain(exact.naive_slope(tensor(logit, dtype), leaf, soft, t))
        allowed = allowed + 2 + 2 * np.abs(log_a) / np.maximum(u, 0.5)
        row = tallies.of("count_slope", COUNT_BOUND + " + 2 + 2 abs(log a) / max(u, 1/2)")
        row.add(got, want * touched, allowed, {"logit": logit, **where}, other, sure)


def check_reference(tallies: Tallies) -> None:
    """The combined reference against mpmath alone."""
    random, (logits, sigmas, distances) = np.random.default_rng(4), exact.axes_of("float64")
    axes = logits[:-2], sigmas, distances, exact.SCALES, exact.TAUS, exact.EPSILONS
    for _ in range(1500):
        logit, sigma, d, s, tau, eps = (float(random.choice(axis)) for axis in axes)
        (u, _), (unit, _) = (exact.decay(sigma, d, dial, eps) for dial in (s, 1.0))
        log_a = exact.log_sigmoid(logit)
        where = {"logit": logit, "sigma_d": sigma, "d": d, "s": s, "tau": tau, "eps": eps}
        if u < 5000:
            got = np.exp(wide([log_a])) * wide([exact.exponential(u)])
            tallies.of("reference: opacity", "0.05").add(got, wide([mpmath.exp(log_a - u)]), 0.05, where)
        if 0 < unit < mpmath.inf:
            upper = mpmath.exp(log_a) / mpf(tau)
            root = upper * mpmath.exp(-mpmath.lambertw(2 * unit * upper**2).real / 2)
            near, level = np.array([float(root * (1 + mpf(10) ** -12))]), wide([exact.log_threshold(tau, 1)])
            got = exact.newton(near, wide([unit]), np.exp(wide([log_a]) - level))
            tallies.of("reference: extinction scale", "0.05").add(got, wide([root]), 0.05, where)


def check(part: str, dtype: str) -> list[dict[str, Any]]:
    """One of ``measure``'s jobs."""
    torch.set_num_threads(1)
    tallies = Tallies(dtype)
    if part == "opacities":
        for case in exact.grid(dtype):
            check_attenuation(tallies, case)
            check_opacities(tallies, case)
            check_drawn(tallies, case, "anywhere")
    elif part == "rest":
        for case in exact.at_the_threshold(dtype):
            check_drawn(tallies, case, "at the threshold")
        check_growth(tallies)
        check_extinction(tallies)
        check_inverse(tallies)
        check_counts(tallies)
    else:
        check_reference(tallies)
    return [tally.row() for tally in tallies.found.values()]


def measure() -> list[dict[str, Any]]:
    """A row per quantity and dtype, on two processes; exits with a message where long double is float64."""
    if np.finfo(Wide).eps > 1e-18:
        sys.exit("numpy's long double is no wider than float64 on this machine: run it on x86")
    jobs = [*itertools.product(("opacities", "rest"), DTYPES), ("reference", "float64")]
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        return [row for rows in pool.map(check, *zip(*jobs, strict=True)) for row in rows]


def tables(rows: list[dict[str, Any]]) -> str:
    """Points; worst errors and shares of the bounds; shares of points at which the paper's formula fails."""
    by_name: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        by_name.setdefault(row["quantity"], {})[row["dtype"]] = row
    references = [by_name.pop(name) for name in list(by_name) if name.startswith("reference")]
    points, nan, failed = (
        sum(r[key] for f in by_name.values() for r in f.values()) for key in ("points", "nan", "failed")
    )
    worst, naive = [], []
    for name, found in by_name.items():
        wider, bound = found["float64"]["bound"], found["float32"]["bound"]
        if wider != bound:
            bound += f"; float64: {wider.removeprefix(bound).strip()}"
        worst.append([name, bound, *(f"{found[d]['worst']:.2g} ({found[d]['worst_of_bound']:.0%})" for d in DTYPES)])
        naive.append([name, *(f"{found[d]['naive_failed']:.1%} ({found[d]['naive_nan']:.1%})" for d in DTYPES)])
    off = max(found["float64"]["worst"] for found in references)
    return "\n\n".join([
        f"{points:,} points: {nan} NaN, {failed} past the bound", table(["", "bound", *DTYPES], worst, 2),
        "The paper's formula: share of the points at which it fails (NaN):", table(["", *DTYPES], naive, 1),
        f"The reference is off by at most {off:.2f} of float64's eps, measured against mpmath alone.",
    ])  # fmt: skip
