"""Cameras of photographs, by COLMAP, and a base from its points, trained to its end on the training
photographs.

    python benchmarks/from_points.py PHOTOGRAPHS FOLDER --every 5 --thin 2

writes FOLDER/images, FOLDER/sparse/0 and FOLDER/base.ply. The base is plain splatting with a fixed
number of Gaussians: rounds of tuning, after each of which transparent Gaussians are moved to opaque
ones, as in 3DGS as Markov Chain Monte Carlo (arXiv 2404.09591).
"""

import shutil
import sys
import tempfile
from pathlib import Path

import clod_adapter as clod
from clod_adapter.gaussians import SH_C0
from common import arguments
from tuning import Tuning, tune

import numpy as np
import pycolmap
import torch
from PIL import Image, ImageOps
from scipy.spatial import cKDTree

COUNT = 60_000
ROUNDS = 8  # that end with a relocation
ROUND = 250  # steps of each
LAST = 1500  # steps after them
TRANSPARENT = 0.05  # opacity below which a Gaussian is moved
OPACITY = 0.3
SH_COEFFICIENTS = 15


def main():
    parser = arguments(__doc__)
    parser.add_argument("photographs", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--every", type=int, default=1, metavar="K", help="one photograph in K is used"
    )
    parser.add_argument(
        "--thin", type=int, default=1, metavar="K", help="of those with a camera one in K is left"
    )
    parser.add_argument("--size", type=int, default=900, help="pixels of the longer side at most")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        posed = Path(place) / "posed"
        photographs = sorted(args.photographs.iterdir())[:: args.every]
        find_cameras(photographs, args.size, Path(place), posed)
        thin(posed, args.folder, args.thin)
    write_base(args.folder)


def find_cameras(photographs, size, place, folder):
    """COLMAP's largest model of the photographs, undistorted; ``place`` is for what is made on the
    way.
    """
    smaller, database = place / "images", place / "database.db"
    smaller.mkdir()
    for path in photographs:
        image = ImageOps.exif_transpose(Image.open(path)).convert("RGB")
        image.thumbnail((size, size))
        image.save(smaller / f"{path.stem}.jpg", quality=95)
    pycolmap.extract_features(database, smaller, camera_mode=pycolmap.CameraMode.SINGLE)
    pycolmap.match_exhaustive(database)
    models = pycolmap.incremental_mapping(database, smaller, place)
    largest = max(models, key=lambda number: models[number].num_reg_images())
    pycolmap.undistort_images(folder, place / str(largest), smaller)
    model = folder / "sparse" / "0"
    model.mkdir()
    for file in (folder / "sparse").glob("*.bin"):
        file.rename(model / file.name)


def thin(source, folder, every):
    """Copies one photograph in ``every`` by name, and the part of the COLMAP model that is of
    these.
    """
    model = pycolmap.Reconstruction(str(source / "sparse" / "0"))
    images = sorted(model.images.values(), key=lambda image: image.name)
    for place in ("images", "sparse/0"):
        (folder / place).mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(images):
        if k % every:
            model.deregister_frame(image.frame_id)
        else:
            shutil.copy(source / "images" / image.name, folder / "images" / image.name)
    model.write(str(folder / "sparse" / "0"))


def write_base(folder):
    """Trains ``folder/base.ply`` from ``images/`` and ``sparse/0/`` there."""
    base = folder / "base.ply"
    views = clod.load_scene(folder).train
    random = np.random.default_rng(0)
    gaussians = initial(pycolmap.Reconstruction(str(folder / "sparse" / "0")), random)
    seconds = 0.0
    for k in range(ROUNDS):
        tuned, taken = tune(gaussians, views, Tuning(iters=ROUND, seed=k, final=1.0))
        gaussians = relocated(tuned, random)
        seconds += taken
    tuned, taken = tune(gaussians, views, Tuning(iters=LAST, seed=ROUNDS, final=0.01))
    clod.save(base, tuned)
    print(f"{base}: trained in {seconds + taken:.0f} s", file=sys.stderr)


def initial(model, random):
    """COUNT Gaussians at points of the model, each displaced by as much as its neighbours are
    away.
    """
    xyz = np.array([point.xyz for point in model.points3D.values()])
    rgb = np.array([point.color for point in model.points3D.values()]) / 255
    distances = cKDTree(xyz).query(xyz, 4)[0][:, 1:].mean(1)
    rows = random.permutation(np.resize(random.permutation(len(xyz)), COUNT))
    closer = min(1.0, (len(xyz) / COUNT) ** (1 / 3))
    sizes = np.maximum(distances[rows], 1e-6 * np.ptp(xyz)) * closer
    means = xyz[rows] + random.normal(size=(COUNT, 3)) * sizes[:, None]
    return clod.Gaussians(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (COUNT, 1)),
        log_scales=np.tile(np.log(sizes)[:, None], 3).astype(np.float32),
        opacity_logits=np.full(COUNT, np.log(OPACITY / (1 - OPACITY)), np.float32),
        sh0=((rgb[rows] - 0.5) / SH_C0)[:, None].astype(np.float32),
        shN=np.zeros((COUNT, SH_COEFFICIENTS, 3), np.float32),
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


if __name__ == "__main__":
    main()
