"""Quality of checkpoints drawn with the screen-space filter of their training and with others.

No capture has a checkpoint that was trained antialiased. Substitutes are each scene's checkpoint, tuned on the training
photographs with gsplat's antialiasing ("on") and with Mip-Splatting's filter ("mip"). Each checkpoint adds a row to
``results/antialias.jsonl``: the held-out PSNR with each filter, and the choice of ``compare_filters``. One substitute
of each scene is also adapted with the right filter and with the classic one, to photographs and to its own renders.
"""

from __future__ import annotations

import time
from tempfile import TemporaryDirectory
from typing import Any

import clod_adapter as clod
from clod_adapter.alignment.screen_filter import compare_filters
from clod_adapter.config import CLASSIC, FILTERS
from common import append, arguments, capture, checkpoint, photographs
from tuning import Tuning, tune

FILE = "antialias.jsonl"
CLASSIC_FILES = {
    "ci_banana": ("pretrained.ply",), "plush_half": ("pretrained.ply", "pretrained_mask.ply"),
    "bonsai146": ("pretrained.ply",),
}  # fmt: skip
TUNED = ("ci_banana", "plush_half")
TUNED_STEPS, ADAPTED_STEPS = 800, 400
DIALS = (1.0, 2.0, 3.0, 5.0)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="*", default=list(CLASSIC_FILES))
    for name in parser.parse_args().scenes:
        scene = photographs(name)
        for file in CLASSIC_FILES[name]:
            base = clod.load(capture(name) / file)
            append(FILE, {"scene": name, "file": file, "trained": "off", **row(base.gaussians, scene)})
        for trained in ("on", "mip") if name in TUNED else ():
            about = {"scene": name, "file": f"stand-in, {TUNED_STEPS} steps", "trained": trained}
            standin = substitute(name, scene, trained)
            append(FILE, about | row(standin, scene))
            for drawn in ("on", "off") if trained == "on" else ():
                for teacher in ("photographs", "checkpoint"):
                    append(FILE, about | adapted(standin, scene, drawn, teacher))


def substitute(name: str, scene: clod.Scene, trained: str) -> clod.Gaussians:
    """The scene's checkpoint tuned with a filter, written to a file that does not name the filter, as is usual."""
    base = checkpoint(name)
    start = base.gaussians.replace(screen_filter=FILTERS[trained])
    tuned = tune(start, scene.train, Tuning(iters=TUNED_STEPS), lambda share, text: None).gaussians
    with TemporaryDirectory() as folder:
        clod.save(f"{folder}/tuned.ply", tuned.replace(screen_filter=CLASSIC), base)
        return clod.load(f"{folder}/tuned.ply").gaussians


def row(gaussians: clod.Gaussians, scene: clod.Scene) -> dict[str, Any]:
    """Held-out PSNR with each filter, and the choice of ``compare_filters`` with its CPU seconds."""
    psnr = {
        name: round(clod.evaluate(gaussians.replace(screen_filter=each), scene.test, [1.0])[0].psnr, 2)
        for name, each in FILTERS.items()
    }
    began = time.process_time()
    found = compare_filters(gaussians, [*scene.test, *scene.train])
    seconds = time.process_time() - began
    compared = {name: round(value, 2) for name, value in found.psnr.items()}
    chosen = {"chosen": found.chosen, "compared": compared, "compare_cpu_s": round(seconds, 2)}
    return {"count": len(gaussians), "psnr": psnr, **chosen}


def adapted(gaussians: clod.Gaussians, scene: clod.Scene, drawn: str, teacher: str) -> dict[str, Any]:
    """Adapted and drawn with one filter; the teacher is the photographs, or renders of the checkpoint."""
    start = gaussians.replace(screen_filter=FILTERS[drawn])
    own = clod.render_pseudo_views(start, clod.place_cameras(start)) if teacher == "checkpoint" else scene
    result = clod.adapt(start, own, clod.AdaptConfig(max_sv=5, iters=ADAPTED_STEPS))
    rows = [
        {"s": r.virtual_scale, "psnr": round(r.psnr, 2), "kept": round(r.kept)}
        for r in clod.evaluate(result.gaussians, scene.test, DIALS)
    ]
    return {"adapted_with": drawn, "teacher": teacher, "iters": ADAPTED_STEPS, "max_sv": 5, "seed": 0, "rows": rows}


if __name__ == "__main__":
    main()
