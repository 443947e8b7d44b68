"""A large scene against what its user would take instead: PSNR at equal numbers of Gaussians.

    python benchmarks/large.py FINEST.ply --record                                     # without photographs
    python benchmarks/large.py FINEST.ply --levels LEVEL.ply ... --record              # and with an author's levels
    python benchmarks/large.py LEVEL.ply --levels COARSER.ply ... --truth FINEST.ply --record
    python benchmarks/large.py --table

FINEST is adapted without options (max_sv 5). ``levels`` are the coarser ones that its author ships; without them counts
are SHARES of FINEST. splat-transform (``make peers``) decimates FINEST to the same counts, in both its ways, and
``export --lod-meta`` writes a streaming set of the adapted file with about these counts, which splat-transform reads.
PSNR is the mean over VIEWS cameras that training does not use, against renders of FINEST, at s = 0 too: there it says
how far training moved what near views show. With ``--truth`` a coarser level is the checkpoint, and PHOTOGRAPHS
supersampled renders of the finest one are its photographs. ``--adapted`` takes a file of an earlier run.
"""

import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import clod_adapter as clod
from clod_adapter.evaluation.budget import matching_dial
from common import COMMAND, Process, Row, append, arguments, stored, table
from tuning import TIMEOUT, find_tool

import torch
from PIL import Image

FILE, VIEWS, SEED, LONGEST = "large.jsonl", 16, 77, 40.0
SHARES = (0.4, 0.18, 0.08)
PHOTOGRAPHS, SAMPLES = 128, 2  # every 8th is held out; samples along each side of a pixel
OTHERS = {"decimated": "--decimate", "decimated adaptively": "--decimate-adaptive"}


def main() -> None:
    parser = arguments(__doc__, table=print_table, record=FILE)
    parser.add_argument("finest", type=Path)
    parser.add_argument("--levels", nargs="+", type=Path, default=[])
    parser.add_argument("--adapted", type=Path, help="the file of an earlier run, which is not run again")
    parser.add_argument("--truth", type=Path, help="what photographs show; without it there are none")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for row in compared(args.finest, args.levels, args.adapted, args.truth, Path(temporary)):
            scene = args.finest.stem + (f" of {args.truth.stem}" if args.truth else "")
            row = {"benchmark": "large", "scene": scene, **row}
            if args.record:
                append(FILE, row)
            else:
                print(json.dumps(row), flush=True)


def compared(finest: Path, levels: list[Path], adapted: Path | None, truth: Path | None, folder: Path) -> Iterator[Row]:
    """The rows: the run, the dial at 1, 2 and 5 and at each level's count, and its rivals there."""
    base, shown = clod.load(finest).gaussians, clod.load(truth or finest).gaussians
    cameras = clod.place_cameras(shown, views=VIEWS, seed=SEED)
    views = [clod.View(camera, supersampled(shown, camera, SAMPLES if truth else 1)) for camera in cameras]
    out, images = adapted or folder / "adapted.ply", list[object]()
    if truth:
        placed = clod.place_cameras(shown, views=PHOTOGRAPHS, seed=SEED + 1)
        images = ["--images", write_photographs(shown, placed, folder / "photographs")]
        (row,) = clod.evaluate(base, views, [1.0])
        yield {"method": "base", "level": "all", "gaussians": len(base), "share": 1.0, "psnr": row.psnr}
    if adapted is None:
        run = Process([*COMMAND, finest, *images, "--max-sv", 5, "--out", out, "--json", "--accept-loss"])
        report = json.loads(run.out)
        held_out = {row["virtual_scale"]: row["psnr"] for row in report["rows"]}
        yield {"method": "run", "steps": report["steps"], "held_out": held_out, **run.cost()}
    dial = clod.load(out).gaussians
    assert dial.attenuation is not None
    longer = dial.replace(attenuation=replace(dial.attenuation, max_sv=LONGEST))  # beyond what was trained
    counts = {level.stem: len(clod.load(level).gaussians) for level in levels}
    counts = counts or {f"{share:.0%}": round(share * len(base)) for share in SHARES}
    (row,) = clod.evaluate(clod.detach(dial), views, [1.0])
    yield {"method": "dial", "level": "s = 0", "gaussians": len(base), "share": 1.0, "psnr": row.psnr}
    for label, s in (("s = 1", 1.0), ("s = 2", 2.0), ("s = 5", 5.0)):
        (row,) = clod.evaluate(dial, views, [s])
        yield {"method": "dial", "level": label, "gaussians": row.kept, "share": row.kept_share, "psnr": row.psnr}
    for level, count in counts.items():
        share = count / len(base)
        (row,) = clod.evaluate(dial, views, [matching_dial(longer, cameras, count)])
        yield {"method": "dial", "level": level, "gaussians": row.kept, "share": row.kept_share, "psnr": row.psnr}
        authors = [each for each in levels if each.stem == level]
        for name, file in rivals(finest, count, folder, authors):
            if file is None:
                yield {"method": name, "level": level, "failed": "needs a GPU at this size"}
                continue
            found = clod.load(file).gaussians
            (row,) = clod.evaluate(found, views, [1.0])
            yield {"method": name, "level": level, "gaussians": len(found), "share": share, "psnr": row.psnr}
    if len(counts) > 1:  # a streaming set has several levels
        dials = [matching_dial(dial, cameras, count) for count in counts.values()]
        yield from streamed(out, dials, views, len(base), folder)


@torch.no_grad()
def supersampled(shown: clod.Gaussians, camera: clod.Camera, samples: int) -> torch.Tensor:
    """``[H, W, 3]`` uint8, a render with ``samples`` by ``samples`` samples in a pixel."""
    K = camera.K * torch.tensor([[samples], [samples], [1.0]])
    image = clod.render(shown, replace(camera, K=K, width=samples * camera.width, height=samples * camera.height)).image
    image = image.clamp(0, 1).reshape(camera.height, samples, camera.width, samples, 3).mean((1, 3))
    return (255 * image).round().to(torch.uint8)


def write_photographs(shown: clod.Gaussians, cameras: Sequence[clod.Camera], folder: Path) -> Path:
    """A folder of photographs with their transforms.json."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for k, camera in enumerate(cameras):
        name = f"images/{k:04}.png"
        Image.fromarray(supersampled(shown, camera, SAMPLES).numpy()).save(folder / name)
        pose = torch.linalg.inv(camera.viewmat.double()) @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
        K = camera.K.tolist()
        size = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "w": camera.width, "h": camera.height}
        frames.append({"file_path": name, "transform_matrix": pose.tolist(), **size})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}), "utf-8")
    return folder


def rivals(finest: Path, count: int, folder: Path, authors: list[Path]) -> Iterator[tuple[str, Path | None]]:
    """The author's level, if any, and FINEST in ``count`` Gaussians by splat-transform; None where that fails."""
    yield from (("author", level) for level in authors)
    for name, option in OTHERS.items():
        out = folder / "decimated.ply"
        out.unlink(missing_ok=True)
        try:
            find_tool().run("-q", finest, option, str(count), out, timeout=TIMEOUT)
        except clod.ClodError as error:
            if "requires WebGPU" not in str(error):
                raise
        yield name, out if out.exists() else None


def streamed(adapted: Path, dials: list[float], views: list[clod.View], whole: int, folder: Path) -> Iterator[Row]:
    """Each level of the streaming set."""
    out, level = folder / "lod", folder / "level.ply"
    words = [f"--levels={','.join(f'{s:.4f}' for s in sorted(dials))}", "--lod-meta", "--out", out]
    Process([*COMMAND, "export", adapted, *words])
    for number in range(len(dials)):
        level.unlink(missing_ok=True)
        find_tool().run("-q", out / "lod-meta.json", "-L", str(number), level, timeout=TIMEOUT)
        found = clod.load(level).gaussians
        (row,) = clod.evaluate(found, views, [1.0])
        share = len(found) / whole
        yield {"method": "lod-meta", "level": number, "gaussians": len(found), "share": share, "psnr": row.psnr}


def print_table() -> None:
    """The last row of each method and level."""
    last = {(row["scene"], row["method"], row.get("level")): row for row in stored(FILE)}
    lines = [
        [row["scene"], row["method"], str(row["level"]), f"{row['gaussians']:,.0f}", f"{row['share']:.1%}",
         f"{row['psnr']:.2f}"] for row in last.values() if "psnr" in row
    ]  # fmt: skip
    print(table(["scene", "method", "level", "Gaussians", "share", "PSNR"], lines))


if __name__ == "__main__":
    main()
