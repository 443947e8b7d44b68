"""The page in a headless Chromium against clod_adapter.render: pictures, counts, loading times, sizes.

    python benchmarks/viewer.py                      # plush_half, bonsai146 and 500,000 random Gaussians
    python benchmarks/viewer.py plush_half --pack    # also the one-file page packed by splat-transform; minutes

Each capture's checkpoint is first adapted for 100 steps (kept in ``benchmarks/cache``), enough to compare pictures. At
some held-out cameras and dial values, and with the equation off: PSNR between the browser's picture and
``clod_adapter.render``, and the counts. Times are wall times to the first frame with WebGL in software; they do not
predict those of a device with a GPU. Rows are added to ``results/viewer.jsonl``.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import CACHE, COMMAND, ROOT, Process, append, arguments, capture

import clod_adapter as clod
from clod_adapter.adapter import detach
from clod_adapter.config import AttenuationConfig
from clod_adapter.io.formats.splat_transform import SplatTransform
from clod_adapter.viewer.page import write_viewer_page

sys.path.insert(0, str(ROOT / "tests"))
import browser  # noqa: E402
from shown import Shown, serve  # noqa: E402

FILE = "viewer.jsonl"
CAPTURES = ("plush_half", "bonsai146")
DIALS = (1.0, 3.0, 5.0)
CAMERAS = 4
MANY = 500_000


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("captures", nargs="*", default=[*CAPTURES, "many"], help="captures, or many (default: all)")
    parser.add_argument("--pack", action="store_true", help="also the size of the page that splat-transform packs")
    args = parser.parse_args()
    with browser.launch() as chromium:
        for name in args.captures:
            with tempfile.TemporaryDirectory() as folder:
                made = name == "many"
                row = many(chromium, Path(folder)) if made else measure(chromium, name, Path(folder), args.pack)
            append(FILE, row)
            print(summary(row))


def measure(chromium: Any, name: str, folder: Path, packed: bool) -> dict[str, Any]:
    """A capture: pictures and counts at its held-out cameras, loading time, page sizes."""
    path = adapted(name)
    model = clod.load(path)
    views = clod.load_scene(capture(name), origin=model.origin).test
    cameras = [view.camera for view in views[:: max(len(views) // CAMERAS, 1)][:CAMERAS]]
    size = {"width": cameras[0].width, "height": cameras[0].height}
    with serve(path) as url, chromium.new_context(viewport=size) as context:
        shown, seconds = opened(context, url)
        rows = [each for camera in cameras for each in compare(shown, model.gaussians, camera)]
        errors = shown.errors
    sizes, pack_seconds = {"ply": page_size(model, folder, None)}, None
    if packed:
        began = time.perf_counter()
        sizes["sog"] = page_size(model, folder, SplatTransform.find())
        pack_seconds = time.perf_counter() - began
    return {
        "capture": name, "gaussians": len(model.gaussians), "sh_degree": model.gaussians.sh_degree, "picture": size,
        "chromium": chromium.version, "first_frame_seconds": seconds, "rows": rows, "errors": errors,
        "page_bytes": sizes, "pack_seconds": pack_seconds,
    }  # fmt: skip


def compare(shown: Shown, gaussians: clod.Gaussians, camera: clod.Camera) -> list[dict[str, Any]]:
    """A camera at each dial value, and with the equation off (dial None)."""
    shown.camera(camera)
    rows = []
    for dial in (*DIALS, None):
        shown.run(f"clod.setEquation({str(dial is not None).lower()})")
        shown.run("clod.setDial(given)", dial or 1.0)
        with torch.no_grad():
            wanted = clod.render(gaussians, camera, dial) if dial else clod.render(detach(gaussians), camera)
        error = float(((shown.picture().astype(np.float64) - wanted.pixels.numpy()) ** 2).mean())
        rows.append({
            "camera": camera.name, "virtual_scale": dial, "psnr": 10 * float(np.log10(255**2 / max(error, 1e-9))),
            "kept": int(wanted.kept.sum()), "kept_in_page": shown.counts()["kept"],
        })  # fmt: skip
    return rows


def many(chromium: Any, folder: Path) -> dict[str, Any]:
    """Made-up Gaussians of SH degree 3: until they are seen."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    made = clod.Gaussians(
        normal(MANY, 3), normal(MANY, 4), normal(MANY, 3) * 0.5 - 5, normal(MANY), normal(MANY, 1, 3),
        normal(MANY, 15, 3) * 0.1, normal(MANY).exp(), AttenuationConfig(cut="soft", tau=0.02, scene_distance=3.0),
    )  # fmt: skip
    path = folder / "many.ply"
    clod.save(path, made)
    with serve(path) as url, chromium.new_context(viewport={"width": 640, "height": 480}) as context:
        shown, seconds = opened(context, url)
        began = time.perf_counter()
        shown.run("clod.setDial(3)")
        turned = time.perf_counter() - began
        counts = shown.counts()
        return {
            "capture": "many", "gaussians": MANY, "sh_degree": 3, "chromium": chromium.version,
            "first_frame_seconds": seconds, "dial_seconds": turned, "counts": counts, "errors": shown.errors,
            "file_bytes": path.stat().st_size,
        }  # fmt: skip


def opened(context: Any, url: str) -> tuple[Shown, float]:
    """The page, and the seconds until its first frame was drawn."""
    context.set_default_timeout(300_000)
    began = time.perf_counter()
    return Shown(context.new_page()).ready(url), time.perf_counter() - began


def adapted(name: str) -> Path:
    """The capture's checkpoint with a dial."""
    path = CACHE / f"viewer-{name}.ply"
    if not path.exists():
        CACHE.mkdir(exist_ok=True)
        words = [capture(name) / "pretrained.ply", "--images", capture(name), "--max-sv", 5, "--iters", 100, "-o", path]
        Process([*COMMAND, *words])
    return path


def page_size(model: clod.Checkpoint, folder: Path, tool: SplatTransform | None) -> int:
    write_viewer_page(folder / "page.html", model, tool=tool)
    return (folder / "page.html").stat().st_size


def summary(row: dict[str, Any]) -> str:
    lines = [f"{row['capture']}: {row['gaussians']:,} Gaussians, first frame after {row['first_frame_seconds']:.1f} s"]
    for dial in (*DIALS, None):
        found = [each for each in row.get("rows", ()) if each["virtual_scale"] == dial]
        if found:
            errors = [each["psnr"] for each in found]
            apart = max(abs(each["kept"] - each["kept_in_page"]) for each in found)
            label = f"s = {dial:g}" if dial else "equation off"
            lines.append(f"  {label}: {min(errors):.1f} to {max(errors):.1f} dB, mean {statistics.fmean(errors):.1f}, "
                         f"counts apart by at most {apart}")  # fmt: skip
    if "page_bytes" in row:
        lines.append(
            "  one file: " + ", ".join(f"{kind} {size / 1e6:.1f} MB" for kind, size in row["page_bytes"].items())
        )
    if "dial_seconds" in row:
        lines.append(f"  turning the dial: {row['dial_seconds']:.1f} s, {row['counts']['kept']:,} kept")
    return "\n".join([*lines, f"  errors in the console: {len(row['errors'])}"])


if __name__ == "__main__":
    main()
