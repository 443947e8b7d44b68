"""Adapting checkpoints that were trained to their end, on held-out photographs.

    python benchmarks/converged.py plush_half bonsai146 ci_banana --record

The bases are trained on the training photographs of captures of the shared data, from their COLMAP
points, and kept in ``benchmarks/cache``. This is plain splatting with a fixed number of Gaussians:
rounds of tuning, after each of which transparent Gaussians are moved to opaque ones, as in 3DGS as
Markov Chain Monte Carlo (arXiv 2404.09591). Then the default command adapts them.
"""

import tempfile
from pathlib import Path

import clod_adapter as clod
from clod_adapter.gaussians import SH_C0
from common import (
    CACHE,
    Table,
    append,
    arguments,
    capture,
    clod_adapt,
    last,
    photographs,
    psnr_kept,
    quality,
    report_of,
)
from tuning import Tuning, tune

import numpy as np
import pycolmap
import torch
from scipy.spatial import cKDTree

FILE, DIALS = "converged.jsonl", (1.0, 2.0, 5.0)
COUNT, COUNT_EACH = 60_000, 1500  # Gaussians at most; for each photograph
ROUNDS = 8  # that end with a relocation
ROUND = 500  # steps of each
LAST = 3000  # steps after them
TRANSPARENT = 0.05  # opacity below which a Gaussian is moved
OPACITY = 0.3
SH_COEFFICIENTS = 15


def main():
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("scenes", nargs="+", help="folders of the shared data")
    args = parser.parse_args()
    for name in args.scenes:
        views = photographs(name)
        base = trained(name, views.train)
        with tempfile.TemporaryDirectory() as place:
            out = Path(place) / "dial.ply"
            words = ("--images", capture(name), "--out", out, "--accept-loss", "--quiet")
            process = clod_adapt(base, *words)
            row = {
                "name": name,
                "photographs": len(views.train),
                "gaussians": len(clod.load(base).gaussians),
                "base": report_of(out)["base_rows"][0],
                "rows": quality(clod.load(out).gaussians, views.test, DIALS),
                "seconds": round(process.seconds, 1),
            }
        append(FILE, row, args.record)


def trained(name, views):
    """The file of a capture's base, trained now if it is not in the cache."""
    base = CACHE / f"{name}-converged-{ROUNDS * ROUND + LAST}.ply"
    if not base.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        random = np.random.default_rng(0)
        model = pycolmap.Reconstruction(str(capture(name) / "sparse" / "0"))
        gaussians = initial(model, min(COUNT, COUNT_EACH * len(views)), random)
        for k in range(ROUNDS):
            tuned, _ = tune(gaussians, views, Tuning(iters=ROUND, seed=k, final=1.0))
            gaussians = relocated(tuned, random)
        tuned, _ = tune(gaussians, views, Tuning(iters=LAST, seed=ROUNDS, final=0.01))
        clod.save(base, tuned)
    return base


def initial(model, count, random):
    """Gaussians at points of the model, each displaced by as much as its neighbours are away."""
    xyz = np.array([point.xyz for point in model.points3D.values()])
    rgb = np.array([point.color for point in model.points3D.values()]) / 255
    distances = cKDTree(xyz).query(xyz, 4)[0][:, 1:].mean(1)
    rows = random.permutation(np.resize(random.permutation(len(xyz)), count))
    closer = min(1.0, (len(xyz) / count) ** (1 / 3))
    sizes = np.maximum(distances[rows], 1e-6 * np.ptp(xyz)) * closer
    means = xyz[rows] + random.normal(size=(count, 3)) * sizes[:, None]
    return clod.Gaussians(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.tile(np.log(sizes)[:, None], 3).astype(np.float32),
        opacity_logits=np.full(count, np.log(OPACITY / (1 - OPACITY)), np.float32),
        sh0=((rgb[rows] - 0.5) / SH_C0)[:, None].astype(np.float32),
        shN=np.zeros((count, SH_COEFFICIENTS, 3), np.float32),
    )


def relocated(gaussians, random):
    """Transparent Gaussians become copies of opaque ones, chosen by opacity; both have half the
    optical depth.
    """
    opacities = gaussians.opacities.double().numpy()
    dead = np.flatnonzero(opacities < TRANSPARENT)
    alive = np.flatnonzero(opacities >= TRANSPARENT)
    chosen = random.choice(alive, len(dead), p=opacities[alive] / opacities[alive].sum())
    rows = np.arange(len(gaussians))
    rows[dead] = chosen
    copies = gaussians.select(torch.from_numpy(rows))
    shared = np.isin(rows, chosen)
    halved = 1 - np.sqrt(1 - np.minimum(opacities[rows], 0.99))
    logits = np.where(shared, np.log(halved / (1 - halved)), copies.opacity_logits.numpy())
    sizes = copies.log_scales.exp().numpy()
    shifts = np.zeros((len(rows), 3))
    shifts[dead] = random.normal(size=(len(dead), 3)) * 0.5 * sizes[dead].mean(1, keepdims=True)
    return copies.replace(
        means=(copies.means + torch.from_numpy(shifts)).float(),
        opacity_logits=torch.from_numpy(logits).float(),
    )


def page_table():
    """The bases, and the dial of each."""
    found = last(FILE, "name", "photographs")
    lines = []
    for (name, count), row in found.items():
        head = f"{name}, {count}"
        lines.append([head, f"{row['base']['psnr']:.2f}", *map(psnr_kept, row["rows"])])
    heads = ["capture, photographs", "base", *(f"s = {s:g}" for s in DIALS)]
    return Table(heads, lines, found.values())


if __name__ == "__main__":
    main()
