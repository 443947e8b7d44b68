"""Quality after adapting a base that was trained to its end, with few photographs, on held-out
photographs.

    # folders with images/, sparse/0/ and base.ply
    python benchmarks/converged.py FOLDER [FOLDER ...] --record
    python benchmarks/converged.py plush_half bonsai146 --every 3 --record
    python benchmarks/converged.py plush_half bonsai146 --every 3 --base pretrained.ply --record
    python benchmarks/converged.py --table    # the rows as a Markdown table

Runs the default command on ``base.ply``. With ``--every`` the folders are captures of the shared
data, of which that part of the photographs, by name, is copied to a folder in ``benchmarks/cache``;
those held out there are held out from the capture too. The base is trained there from the COLMAP
points (``from_points.py``), or, with ``--base``, is that checkpoint, trained on all photographs,
and tuned further on those that are left.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import clod_adapter as clod
from common import (
    CACHE,
    Row,
    append,
    arguments,
    capture,
    clod_adapt,
    quality,
    report_of,
    stored,
    table,
)
from from_points import thin, write_base
from tuning import Tuning, tune

FILE = "converged.jsonl"
DIALS = (1.0, 2.0, 5.0)
ITERS, FINAL = 1500, 0.01  # of tuning a checkpoint further


def main() -> None:
    parser = arguments(__doc__, table=lambda: print_table(stored(FILE)), record=FILE)
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


def make(source: Path, every: int, start: str | None) -> Path:
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


def run(folder: Path, *, record: bool) -> None:
    """Adapts, measures and prints; with ``record`` adds the row to the results."""
    base, scene = clod.load(folder / "base.ply"), clod.load_scene(folder)
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "dial.ply"
        process = clod_adapt(
            base.path, "--images", folder, "--out", out, "--accept-loss", "--quiet"
        )
        report = report_of(out)
        rows = quality(clod.load(out).gaussians, scene.test, DIALS)
    row: Row = {
        "benchmark": "converged",
        "name": folder.name,
        "photographs": len(scene.train),
        "held_out": len(scene.test),
        "gaussians": len(base.gaussians),
        "base": report["base_rows"][0],
        "rows": rows,
        "steps": report["steps"],
        "seconds": round(process.seconds, 1),
    }
    if record:
        append(FILE, row)
    print_table([row])


def psnr_ssim(point: Row) -> str:
    return f"{point['psnr']:.2f} / {point['ssim']:.3f}"


def print_table(rows: Sequence[Row]) -> None:
    lines = []
    for row in rows:
        line = [row["name"], row["photographs"], f"{row['gaussians']:,}", psnr_ssim(row["base"])]
        line += [f"{psnr_ssim(point)} @ {point['kept_share']:.0%}" for point in row["rows"]]
        lines.append([*line, row["steps"], f"{row['seconds']:.0f}"])
    dials = (f"s = {s:g}" for s in DIALS)
    print(table(["scene", "photographs", "Gaussians", "base", *dials, "steps", "seconds"], lines))


if __name__ == "__main__":
    main()
