"""Merging Gaussians: fewer and larger ones that stand for others, by moments; no photograph is
needed.

A group of Gaussians with masses ``m = opacity area`` becomes one with their total mass, their mean
``mu`` weighted by mass, the covariance ``mean of (C_i + (mu_i - mu)(mu_i - mu)^T)``, and the mean
of their harmonics. Its opacity is the mass over its own area, at most OPAQUEST. The two whose
merging changes least are merged first: by the change of shape and colour times
``sqrt(w_i w_j / (w_i + w_j))``, with w their importance, which is 1 where none is given.

After Gaussian mixture reduction (Runnalls, "Kullback-Leibler approach to Gaussian mixture
reduction", 2007), with the area of an ellipsoid (Thomsen's formula) as splat-transform weighs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter._support.arrays import float64_array
from clod_adapter.gaussians import Gaussians
from clod_adapter.initialization.neighbours import nearest, without_crowds
from clod_adapter.progress import Listener, Phase, tell

NEIGHBOURS = 12  # of each Gaussian, with which it may be merged in a round
COLOUR = 2.0  # weight of the squared difference of harmonics
ROUND = 0.25  # of the remaining that one round removes at most
# the same where all matter alike: nearly all are merged once before one is merged again, which
# keeps what is small beside what is large
ROUND_ALIKE = 0.5
LEAST = 1e-3  # of a cost, and share of the mean importance: below, differences do not matter
OPAQUEST = 0.999
THINNEST = 1e-8  # added to variances, world units^2
EDGES = 1 << 16  # pairs that are compared at a time
THOMSEN = 1.6075


@dataclass(frozen=True)
class Mixture:
    """Masses ``[N]``, centres ``[N, 3]``, covariances ``[N, 3, 3]``, harmonics ``[N, 3 K]``."""

    mass: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    harmonics: np.ndarray

    def __len__(self) -> int:
        return len(self.mass)

    def merged(self, groups: np.ndarray) -> Mixture:
        """One Gaussian for each of the ``groups [N]``, numbered from 0."""
        total = np.bincount(groups, self.mass)
        share = self.mass / total[groups]

        def mean(values: np.ndarray) -> np.ndarray:
            columns = values.reshape(len(values), -1).T
            means = [np.bincount(groups, share * column) for column in columns]
            return np.stack(means, 1).reshape(-1, *values.shape[1:])

        means = mean(self.means)
        covariances = mean(self.covariances + _products(self.means - means[groups]))
        return Mixture(total, means, covariances, mean(self.harmonics).astype(np.float32))


@np.errstate(under="ignore")
def merge(
    gaussians: Gaussians,
    count: int,
    importance: Tensor | None = None,
    progress: Listener | None = None,
) -> Gaussians:
    """About ``count`` Gaussians, without a dial, that stand for all of them; themselves, but for
    rounding, if there are no more.

    Args:
        importance: ``[N]``, at least 0, how much a Gaussian matters to the pictures; merged ones
            have the sum. Without it all matter alike, what nobody sees too: right for one plain
            file, which nothing trains.
    """
    mixture = mixture_of(gaussians)
    before = len(gaussians)
    share = ROUND_ALIKE if importance is None else ROUND
    weights = np.ones(before) if importance is None else float64_array(importance)
    # of what no view shows, the most similar are merged first
    weights = weights + LEAST * weights.mean()
    while len(mixture) > count:
        least = int((1 - share) * len(mixture))
        groups = _groups(mixture, weights, max(count, least))
        if groups.max() + 1 == len(mixture):
            break
        mixture = mixture.merged(groups)
        weights = np.ones(len(mixture)) if importance is None else np.bincount(groups, weights)
        tell(progress, Phase.MERGING, before - len(mixture), before - count)
    return gaussians_of(mixture, gaussians)


def mixture_of(gaussians: Gaussians) -> Mixture:
    from scipy.spatial.transform import Rotation

    scales = float64_array(gaussians.log_scales.double().exp())
    quats = float64_array(gaussians.quats)[:, [1, 2, 3, 0]]
    axes = Rotation.from_quat(quats).as_matrix()
    covariances = np.einsum("nij,nj,nkj->nik", axes, scales**2, axes)
    mass = float64_array(gaussians.opacities) * _areas(scales) + np.finfo(np.float32).tiny
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1).detach().float().cpu()
    harmonics = coefficients.flatten(1).numpy()
    return Mixture(mass, float64_array(gaussians.means), covariances, harmonics)


def gaussians_of(mixture: Mixture, like: Gaussians) -> Gaussians:
    """The Gaussians of a mixture, with the screen filter and the SH degree of ``like``."""
    from scipy.spatial.transform import Rotation

    variances, axes = np.linalg.eigh(mixture.covariances)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    scales = np.sqrt(np.maximum(variances, THINNEST**2))
    opacities = np.clip(mixture.mass / _areas(scales), 1e-6, OPAQUEST)
    harmonics = mixture.harmonics.reshape(len(mixture), -1, 3)
    arrays = {
        "means": mixture.means,
        "quats": Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]],
        "log_scales": np.log(scales),
        "opacity_logits": np.log(opacities / (1 - opacities)),
        "sh0": harmonics[:, :1],
        "shN": harmonics[:, 1:],
    }
    fields: Any = {}
    for name, array in arrays.items():
        tensor = torch.from_numpy(np.ascontiguousarray(array, np.float32))
        fields[name] = tensor.to(like.means)
    return Gaussians(**fields, screen_filter=like.screen_filter)


def _groups(mixture: Mixture, weights: np.ndarray, count: int) -> np.ndarray:
    """``[N]`` the number of each Gaussian's group, a pair or a single one: the cheapest pairs,
    until ``count`` groups remain or there are no more pairs.
    """
    partner = np.arange(len(mixture))
    remaining = len(mixture)
    for first, second in _cheapest(mixture, weights):
        pairs = slice(remaining - count)
        partner[first[pairs]] = second[pairs]
        partner[second[pairs]] = first[pairs]
        remaining -= len(first[pairs])
        if remaining <= count:
            break
    first_rows = np.minimum(np.arange(len(mixture)), partner)
    return np.unique(first_rows, return_inverse=True)[1]


def _cheapest(mixture: Mixture, weights: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of neighbours in rounds, each Gaussian in one pair at most: a round has the pairs that
    are the cheapest for both of their Gaussians among those that are still free, by rising cost.
    """
    i, j = _neighbours(mixture)
    total = np.maximum(weights[i] + weights[j], np.finfo(float).tiny)
    weight = np.sqrt(weights[i] * weights[j] / total)
    order = np.argsort((_cost(mixture, i, j) + LEAST) * weight, kind="stable")
    i = i[order]
    j = j[order]
    free = np.ones(len(mixture), bool)
    while len(i):
        edges = np.arange(len(i))
        first = np.full(len(mixture), len(i))
        np.minimum.at(first, i, edges)
        np.minimum.at(first, j, edges)
        cheapest = (first[i] == edges) & (first[j] == edges)
        yield i[cheapest], j[cheapest]
        free[i[cheapest]] = free[j[cheapest]] = False
        both_free = free[i] & free[j]
        i = i[both_free]
        j = j[both_free]


def _neighbours(mixture: Mixture) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of a Gaussian and one of its nearest NEIGHBOURS, each pair once: the smaller rows,
    and the larger ones.
    """
    sizes = np.sqrt(mixture.covariances.max((1, 2)))  # the largest is on the diagonal
    pairs = []
    for rows, _, near in nearest(without_crowds(mixture.means, sizes), NEIGHBOURS):
        low = np.minimum(rows[:, None], near)
        high = np.maximum(rows[:, None], near)
        pairs.append((low * len(mixture) + high)[low < high])
    return np.divmod(np.unique(np.concatenate(pairs)), len(mixture))


def _cost(mixture: Mixture, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The cost of merging two: the entropy of the merged shape above the mean of both, and the
    squared difference of colours.
    """
    cost = np.empty(len(first))
    entropy = _log_determinants(mixture.covariances)
    for start in range(0, len(first), EDGES):
        block = slice(start, start + EDGES)
        i = first[block]
        j = second[block]
        p = mixture.mass[i] / (mixture.mass[i] + mixture.mass[j])
        q = 1 - p
        apart = mixture.means[i] - mixture.means[j]
        between = _products(np.sqrt(p * q)[:, None] * apart)
        merged = (
            p[:, None, None] * mixture.covariances[i]
            + q[:, None, None] * mixture.covariances[j]
            + between
        )
        shape = _log_determinants(merged) - p * entropy[i] - q * entropy[j]
        colours = mixture.harmonics[i] - mixture.harmonics[j]
        cost[block] = shape / 2 + COLOUR * np.square(colours).sum(1)
    return cost


def _products(vectors: np.ndarray) -> np.ndarray:
    """``[N, 3, 3]`` products ``v v^T`` of vectors ``[N, 3]``."""
    return vectors[:, :, None] * vectors[:, None]


def _log_determinants(covariances: np.ndarray) -> np.ndarray:
    """``[N]`` logarithms of the determinants of covariances ``[N, 3, 3]``."""
    determinants = np.linalg.det(covariances + THINNEST * np.eye(3))
    return np.log(np.maximum(determinants, np.finfo(np.float64).tiny))


def _areas(scales: np.ndarray) -> np.ndarray:
    """``[N]`` areas of ellipsoids, over 4 pi."""
    x, y, z = scales.T
    sides = np.stack([x * y, x * z, y * z])
    return np.mean(sides**THOMSEN, 0) ** (1 / THOMSEN)
