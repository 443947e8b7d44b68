"""The dial of an adapted PLY after another tool has rewritten the file without the header's comments.

    python benchmarks/constants.py plush_half --iters 200
    python benchmarks/constants.py --table                  # the rows as a Markdown table

A checkpoint is adapted with each of some settings and saved. The held-out views are measured at each dial value on the
file as written, as plyfile rewrites it without comments, as splat-transform rewrites it where that is installed, and on
the format of earlier versions, with sigma_d in units of the typical distance. ``same``: all numbers and kept Gaussians
equal those of the file as written. ``note``: the message on loading. Each setting adds a row to
``results/constants.jsonl``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from common import append, arguments, checkpoint, photographs, stored, table
from plyfile import PlyData, PlyElement

import clod_adapter as clod
from clod_adapter.errors import ClodError
from clod_adapter.io.formats.splat_transform import SplatTransform, time_limit
from clod_adapter.io.settings import WARNING
from clod_adapter.render import render
from clod_adapter.units import with_distance

FILE = "constants.jsonl"
DIALS = (1.0, 2.0, 3.0, 5.0)
SETTINGS: dict[str, clod.AdaptConfig] = {
    "default": clod.AdaptConfig(),
    "tau 0.013": clod.AdaptConfig(tau=0.013),
    "normalizer max": clod.AdaptConfig(normalizer="max"),
    "normalizer quantile": clod.AdaptConfig(normalizer="quantile"),
    "form paper": clod.AdaptConfig.paper(),
}


def main() -> None:
    parser = arguments(__doc__, table=print_table)
    parser.add_argument("scenes", nargs="*", help="captures of the shared data")
    parser.add_argument("--iters", type=int, default=200)
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=[*SETTINGS])
    args = parser.parse_args()
    for scene in args.scenes:
        for name in args.settings:
            about = {"benchmark": "constants", "scene": scene, "settings": name}
            append(FILE, about | measure(scene, name, args.iters))


def measure(scene: str, name: str, iters: int) -> dict[str, Any]:
    base, scenery = checkpoint(scene), photographs(scene)
    config = clod.AdaptConfig(**{**asdict(SETTINGS[name]), "iters": iters})
    result = clod.adapt(base.gaussians, scenery, config).gaussians
    found: dict[str, Any] = {}
    with TemporaryDirectory() as folder:
        clod.save(Path(folder) / "model.ply", result, base)
        wanted = look(Path(folder) / "model.ply", scenery.test)
        for tool, path in rewritten(Path(folder), result):
            got = look(path, scenery.test)
            found[tool] = {"same": got["rows"] == wanted["rows"] and torch.equal(got["kept"], wanted["kept"]),
                           "rows": got["rows"], "note": got["note"]}  # fmt: skip
    return {"config": asdict(config), "gaussians": len(result), "views": len(scenery.test),
            "reference_distance": result.attenuation and result.attenuation.reference_distance,
            "written": wanted["rows"], **found}  # fmt: skip


def rewritten(folder: Path, result: clod.Gaussians) -> Iterator[tuple[str, Path]]:
    """(tool, file): the saved file rewritten by each tool, and in the format of earlier versions."""
    model = PlyData.read(str(folder / "model.ply"))["vertex"].data
    PlyData([PlyElement.describe(model, "vertex")], byte_order="<").write(str(folder / "plyfile.ply"))
    yield "plyfile", folder / "plyfile.ply"
    try:
        tool = SplatTransform.find()
        tool.run(folder / "model.ply", folder / "tool.ply", timeout=time_limit(len(model)))
        yield f"splat-transform {tool.version}", folder / "tool.ply"
    except ClodError as error:
        print(f"without splat-transform: {error}")
    assert result.attenuation is not None
    if result.attenuation.normalizer == "scene":
        then = with_distance(result, result.attenuation.reference_distance).sigma_d
        assert then is not None
        model["sigma_d"] = then.numpy()
        PlyData([PlyElement.describe(model, "vertex")], byte_order="<").write(str(folder / "earlier.ply"))
        yield "plyfile, of an earlier version", folder / "earlier.ply"


def look(path: Path, views: Sequence[clod.View]) -> dict[str, Any]:
    """The held-out views at each dial value: numbers, kept Gaussians, and the message on loading."""
    model = clod.load(path)
    rows = clod.evaluate(model.gaussians, views, DIALS)
    kept = [render(model.gaussians, view.camera, s).kept for view in views for s in DIALS]
    numbers = [{"virtual_scale": r.virtual_scale, "psnr": r.psnr, "ssim": r.ssim, "kept": r.kept} for r in rows]
    return {"rows": numbers, "kept": torch.stack(kept), "note": "; ".join(model.notes)}


def print_table() -> None:
    """A line for each file, with PSNR @ share kept at each dial value."""
    lines = []
    for row in stored(FILE):
        files = {"as written": {"same": "", "rows": row["written"], "note": ""}}
        files |= {name: value for name, value in row.items() if isinstance(value, dict) and "same" in value}
        for name, file in files.items():
            cells = [f"{r['psnr']:.2f} @ {r['kept'] / row['gaussians']:.1%}" for r in file["rows"]]
            said = "warning" if file["note"].startswith(WARNING) else "note" if file["note"] else ""
            lines.append([f"{row['scene']}, {row['settings']}", name, file["same"], *cells, said])
    print(table(["scene, settings", "file", "same", *(f"s = {s:g}" for s in DIALS), "message"], lines))


if __name__ == "__main__":
    main()
