"""Quality after adapting a base that was trained to its end, with few photographs, on held-out photographs.

    python benchmarks/converged.py FOLDER [FOLDER ...] --record       # folders with images/, sparse/ and base.ply
    python benchmarks/converged.py plush_half bonsai146 --base pretrained.ply --every 3 --record
    python benchmarks/converged.py --table                            # the rows as a Markdown table

Runs the default command on ``base.ply``. With ``--base`` the folders are captures of the shared data: of each, every
third photograph by name is copied to a folder in ``benchmarks/cache``, where that checkpoint is tuned further on those
photographs that are for training. Those held out there are held out from the capture too.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

import clod_adapter as clod
from common import CACHE, COMMAND, Process, Row, append, arguments, capture, stored, table
from tuning import Tuning, tune

import pycolmap

FILE = "converged.jsonl"
DIALS = (1.0, 2.0, 5.0)
ITERS, FINAL = 1500, 0.01


def main() -> None:
    parser = arguments(__doc__, table=print_table, record=FILE)
    parser.add_argument("folders", nargs="+", metavar="FOLDER")
    parser.add_argument("--base", metavar="CHECKPOINT", help="make base.ply from this file of the capture")
    parser.add_argument("--every", type=int, default=3, metavar="K", help="with --base: one photograph in K is used")
    parser.add_argument("--iters", type=int, default=ITERS, help="with --base: steps of tuning")
    args = parser.parse_args()
    for name in args.folders:
        folder = make(name, args.base, args.every, args.iters) if args.base else Path(name).resolve()
        run(folder, record=args.record)


def make(name: str, start: str, every: int, iters: int) -> Path:
    """The folder of the thinned capture with its base, made now if it is not in the cache."""
    source, folder = capture(name), CACHE / f"{name}-{Path(start).stem}-{every}-{iters}"
    base = folder / "base.ply"
    if not base.exists():
        thin(source, folder, every)
        begun = clod.load(source / start)
        tuned, seconds = tune(begun.gaussians, clod.load_scene(folder).train, Tuning(iters=iters, final=FINAL))
        clod.save(base, tuned, begun)
        print(f"{base}: {iters} steps in {seconds:.0f} s", file=sys.stderr)
    return folder


def thin(source: Path, folder: Path, every: int) -> None:
    """Copies one photograph in ``every`` by name, and the part of the COLMAP model that is of these."""
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


def run(folder: Path, *, record: bool) -> None:
    """Adapts, measures and prints; with ``record`` adds the row to the results."""
    base, scene = clod.load(folder / "base.ply"), clod.load_scene(folder)
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "dial.ply"
        process = Process([*COMMAND, base.path, "--images", folder, "--out", out, "--accept-loss", "--quiet"])
        report = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
        rows = clod.evaluate(clod.load(out).gaussians, scene.test, DIALS)
    row: Row = {
        "benchmark": "converged", "name": folder.name, "photographs": len(scene.train), "held_out": len(scene.test),
        "gaussians": len(base.gaussians), "base": report["base_rows"][0], "rows": [each.as_dict() for each in rows],
        "steps": report["steps"], "seconds": round(process.seconds, 1),
    }  # fmt: skip
    if record:
        append(FILE, row)
    print(table(HEADS, [cells(row)]))


HEADS = ["scene", "photographs", "Gaussians", "base", *(f"s = {s:g}" for s in DIALS), "steps", "seconds"]


def cells(row: Row) -> list[object]:
    quality = [f"{each['psnr']:.2f} / {each['ssim']:.3f} @ {each['kept_share']:.0%}" for each in row["rows"]]
    base = f"{row['base']['psnr']:.2f} / {row['base']['ssim']:.3f}"
    seconds = f"{row['seconds']:.0f}"
    return [row["name"], row["photographs"], f"{row['gaussians']:,}", base, *quality, row["steps"], seconds]


def print_table() -> None:
    print(table(HEADS, map(cells, stored(FILE))))


if __name__ == "__main__":
    main()
