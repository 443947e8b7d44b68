"""Quality after adapting a base that was trained to its end, with few photographs, on held-out
photographs.

    # folders with images/, sparse/0/ and base.ply
    python benchmarks/converged.py FOLDER [FOLDER ...] --record
    python benchmarks/converged.py plush_half bonsai146 --every 3 --record
    python benchmarks/converged.py plush_half bonsai146 --every 3 --base pretrained.ply --record

Runs the default command on ``base.ply``. With ``--every`` the folders are captures of the shared
data, of which that part of the photographs, by name, is copied to a folder in ``benchmarks/cache``;
those held out there are held out from the capture too. The base is trained there from the COLMAP
points (``from_points.py``), or, with ``--base``, is that checkpoint, trained on all photographs,
and tuned further on those that are left.
"""

import tempfile
from pathlib import Path

import clod_adapter as clod
from common import (
    CACHE,
    Table,
    append,
    arguments,
    capture,
    clod_adapt,
    last,
    psnr_kept,
    quality,
    report_of,
)
from from_points import thin, write_base
from tuning import Tuning, tune

FILE = "converged.jsonl"
DIALS = (1.0, 2.0, 5.0)
ITERS, FINAL = 1500, 0.01  # of tuning a checkpoint further
SHOWN = {  # in the table
    "plush_half-3-points": "plush_half",
    "bonsai146-3-points": "bonsai146",
    "room": "a room",
    "pot": "a potted plant",
}


def main():
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("folders", nargs="+", metavar="FOLDER")
    parser.add_argument(
        "--every", type=int, metavar="K", help="captures, of which one photograph in K is used"
    )
    parser.add_argument(
        "--base", metavar="CHECKPOINT", help="with --every: make base.ply from this file"
    )
    args = parser.parse_args()
    for name in args.folders:
        folder = make(capture(name), args.every, args.base) if args.every else Path(name).resolve()
        run(folder, record=args.record)


def make(source, every, start):
    """The folder of the thinned capture with its base, made now if it is not in the cache."""
    folder = CACHE / f"{source.name}-{every}-{Path(start or 'points').stem}"
    base = folder / "base.ply"
    if base.exists():
        return folder
    thin(source, folder, every)
    if start is None:
        write_base(folder)
    else:
        pretrained = clod.load(source / start)
        views = clod.load_scene(folder).train
        tuned, _ = tune(pretrained.gaussians, views, Tuning(iters=ITERS, final=FINAL))
        clod.save(base, tuned, pretrained)
    return folder


def run(folder, *, record):
    """Adapts, measures and prints; with ``record`` adds the row to the results."""
    base, scene = clod.load(folder / "base.ply"), clod.load_scene(folder)
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "dial.ply"
        process = clod_adapt(
            base.path, "--images", folder, "--out", out, "--accept-loss", "--quiet"
        )
        report = report_of(out)
        rows = quality(clod.load(out).gaussians, scene.test, DIALS)
    row = {
        "name": folder.name,
        "photographs": len(scene.train),
        "held_out": len(scene.test),
        "gaussians": len(base.gaussians),
        "base": report["base_rows"][0],
        "rows": rows,
        "steps": report["steps"],
        "seconds": round(process.seconds, 1),
    }
    append(FILE, row, record)


def page_table():
    """Bases that were trained on few photographs alone."""
    rows, lines = [], []
    for (name,), row in last(FILE, "name").items():
        if name in SHOWN:
            rows.append(row)
            label = f"{SHOWN[name]}, {row['photographs']}"
            lines.append([label, f"{row['base']['psnr']:.2f}", *map(psnr_kept, row["rows"])])
    heads = ["capture, photographs", "base", *(f"s = {s:g}" for s in DIALS)]
    return Table(heads, lines, rows)


if __name__ == "__main__":
    main()
