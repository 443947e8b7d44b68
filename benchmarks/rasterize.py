"""Times of the CPU rasterizer and of a C++ baseline; or its agreement with a float64 reference.

The baseline is the yardstick, a hand-written C++ kernel outside the repository, built with g++; its
fields are null where it is absent. Each runs in its own process with 2 threads, in turn step by
step, so that drift of the machine affects both alike. Times are medians in milliseconds:
``forward_ms`` and ``both_ms`` of one step with all gradients, ``render_ms`` of a frame without
gradients, and of frames of the most opaque Gaussians.
"""

import importlib.util
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any

import workloads
from clod_adapter.rasterizers import cpu, reference
from common import ROOT, Row, append, arguments
from workloads import Workload

import torch
from torch import Tensor

FILE = "rasterize.jsonl"
YARDSTICK = Path(os.environ.get("CLOD_YARDSTICK", ROOT.parent / "shared" / "yardstick"))
THREADS, WARM, REPEATS = 2, 2, 15
SHARES = (1.0, 0.5, 0.25, 0.1)
SMALL = (3000, 160, 107, 1)  # Gaussians, width, height and seed of the comparison in float64
Jobs = dict[str, Callable[[], Any]]
JOBS: Jobs = {}  # of a worker's process


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument(
        "--accuracy", action="store_true", help="agreement with float64 instead of times"
    )
    args = parser.parse_args()
    torch.set_num_threads(THREADS)
    kind = "accuracy" if args.accuracy else "speed"
    for row in accuracy() if args.accuracy else speed():
        print(json.dumps(row, indent=1), flush=True)
        if args.record:
            append(FILE, {"benchmark": "rasterize", "kind": kind, **row})


def speed() -> list[Row]:
    """All times of each workload."""
    with tempfile.TemporaryDirectory() as folder:
        library, rows = build_yardstick(YARDSTICK, Path(folder)), []
        for name, (count, width, height, _) in workloads.SIZES.items():
            workers = {"": worker(our_jobs, name)}
            if library:
                workers["yardstick_"] = worker(yardstick_jobs, name, library)
            steps = [
                {who: pool.submit(_run, "step").result() for who, pool in workers.items()}
                for _ in range(REPEATS + WARM)
            ]
            frames = [workers[""].submit(_run, "frames").result() for _ in range(REPEATS + WARM)]
            row = {
                "workload": name,
                "gaussians": count,
                "width": width,
                "height": height,
                "repeats": REPEATS,
            }
            for who in ("", "yardstick_"):
                for k, what in enumerate(("forward", "both")):
                    row[f"{who}{what}_ms"] = middle([step[who][k] for step in steps if who in step])
            ways = [(way, share) for way in ("rows removed", "opacity 0") for share in SHARES]
            row["kept"] = [
                {"way": way, "share": share, "ms": middle(times)}
                for (way, share), times in zip(ways, zip(*frames, strict=True), strict=True)
            ]
            rows.append(row | {"render_ms": row["kept"][0]["ms"]})
            for pool in workers.values():
                pool.shutdown()
    return rows


def worker(make: Callable[..., Jobs], *given: Any) -> ProcessPoolExecutor:
    """A process of its own: the yardstick's library, for example, makes its process flush denormal
    numbers.
    """
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=spawn, initializer=_start, initargs=(make, *given))


def _start(make: Callable[..., Jobs], *given: Any) -> None:
    torch.set_num_threads(THREADS)
    JOBS.update(make(*given))


def _run(job: str) -> Any:
    return JOBS[job]()


def middle(times: Sequence[float]) -> float | None:
    """The median without the first repeats."""
    return round(median(times[WARM:]), 2) if times[WARM:] else None


def our_jobs(name: str) -> Jobs:
    """A step; and frames of the most opaque: the others' rows removed, then their opacities 0, as
    the dial does.
    """
    workload = workloads.make(name)
    draw, leaves = ours(workload)
    rank = workload.opacities.argsort(descending=True).argsort()
    keep = [rank < share * len(rank) for share in SHARES]
    fewer = [workload.changed("", rows) for rows in keep]
    fewer += [
        workload.changed("", opacities=torch.where(rows, workload.opacities, 0)) for rows in keep
    ]
    frames = [ours(part)[0] for part in fewer]
    return {
        "step": lambda: timed_step(draw, leaves, workload.weights),
        "frames": lambda: [timed_frame(frame) for frame in frames],
    }


def ours(workload: Workload) -> tuple[Callable[[], Tensor], list[Tensor]]:
    """A function that draws the workload with our rasterizer, and the leaves of its gradients."""
    leaves = {name: value.clone().requires_grad_() for name, value in workload.parameters().items()}
    background = torch.zeros(3)
    return lambda: cpu.rasterize(**leaves, camera=workload.camera, background=background)[0], list(
        leaves.values()
    )


def timed_step(draw: Callable[[], Tensor], leaves: list[Tensor], weights: Tensor) -> list[float]:
    """Milliseconds of the forward part and of a whole step: all gradients of a weighted sum of the
    pixels.
    """
    for leaf in leaves:
        leaf.grad = None
    began = time.perf_counter()
    image = draw()
    drawn = time.perf_counter()
    (image * weights).sum().backward()
    return [(drawn - began) * 1e3, (time.perf_counter() - began) * 1e3]


@torch.no_grad()
def timed_frame(draw: Callable[[], Tensor]) -> float:
    began = time.perf_counter()
    draw()
    return (time.perf_counter() - began) * 1e3


def yardstick_jobs(name: str, library: Path) -> Jobs:
    binding, workload = load_module(YARDSTICK / "binding.py"), workloads.make(name)
    kernel, camera = binding.Lib(str(library), THREADS), workload.camera
    fields = ("means", "scales", "quats", "opacities", "sh")
    leaves = {field: getattr(workload, field).clone().requires_grad_() for field in fields}
    scene = {
        **leaves,
        "viewmat": camera.viewmat,
        "K": camera.K,
        "W": camera.width,
        "H": camera.height,
    }
    return {
        "step": lambda: timed_step(
            lambda: binding.render(kernel, scene)[0], list(leaves.values()), workload.weights
        )
    }


def build_yardstick(source: Path, folder: Path) -> Path | None:
    """The yardstick's library, built as its ``measure.py`` does; None where its source or g++ is
    absent.

    Exits with a message where its scenes differ from ours.
    """
    if not (source / "kernel.cpp").is_file() or not shutil.which("g++"):
        print(
            f"the yardstick is left out: there is no {source / 'kernel.cpp'}, or no g++",
            file=sys.stderr,
        )
        return None
    theirs = load_module(source / "workload.py")
    for name, size in workloads.SIZES.items():
        different = workloads.differences(workloads.make(name), theirs.make(*size))
        if different:
            sys.exit(f"{name} is not the yardstick's: {', '.join(different)} differ")
    library = folder / "libyardstick.so"
    options = [
        "-O3",
        "-march=native",
        "-ffast-math",
        "-std=c++17",
        "-fopenmp",
        "-shared",
        "-fPIC",
        "-DTS=32",
    ]
    subprocess.run(["g++", *options, str(source / "kernel.cpp"), "-o", str(library)], check=True)
    return library


def load_module(path: Path) -> Any:
    """A module from a file that is not on the path."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def accuracy() -> list[Row]:
    """Image and gradients of a small room against ``rasterizers/reference.py`` in float64; and one
    thread against two.

    Float32 rounding may decide otherwise whether an alpha reaches 1/255 or a pixel ends: those
    pixels are ``flipped``.
    """
    scene = workloads.make("small", SMALL)
    exact, expected = differentiate(scene, reference.rasterize, torch.float64)
    image, found = differentiate(scene, cpu.rasterize, torch.float32)
    torch.set_num_threads(1)
    single, alone = differentiate(scene, cpu.rasterize, torch.float32)
    error = (image - exact).abs().amax(-1)
    flipped = error > 1e-4
    apart = {
        name: ((found[name] - expected[name]).norm() / expected[name].norm()).item()
        for name in found
    }
    return [
        {
            "workload": "small",
            "gaussians": len(scene.means),
            "pixels": error.numel(),
            "flipped": int(flipped.sum()),
            "error": error[~flipped].max().item(),
            "gradient_errors": apart,
            "one_thread_alike": torch.equal(single, image)
            and all(torch.equal(alone[n], found[n]) for n in found),
        }
    ]


def differentiate(
    scene: Workload, draw: Callable[..., Any], dtype: torch.dtype
) -> tuple[Tensor, dict[str, Tensor]]:
    """The image, and the gradients of its weighted sum."""
    leaves = {name: value.to(dtype).requires_grad_() for name, value in scene.parameters().items()}
    image = draw(**leaves, camera=scene.camera, background=torch.zeros(3, dtype=dtype))[0]
    found = torch.autograd.grad((image * scene.weights).sum(), list(leaves.values()))
    return image.detach(), dict(zip(leaves, found, strict=True))


if __name__ == "__main__":
    main()
