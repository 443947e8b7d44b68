"""Times of the CPU rasterizer and of a C++ baseline; or its agreement with a float64 reference.

The baseline is the yardstick, a hand-written C++ kernel outside the repository, built with g++; its
fields are null where it is absent. Each runs in its own process with 2 threads, in turn step by
step, so that drift of the machine affects both alike. Times are medians in milliseconds:
``forward_ms`` and ``both_ms`` of one step with all gradients, ``render_ms`` of a frame without
gradients, and of frames of the most opaque Gaussians.
"""

import importlib.util
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import workloads
from clod_adapter.rasterizers import cpu, reference
from common import ROOT, Table, append, arguments, last

import torch

FILE = "rasterize.jsonl"
YARDSTICK = Path(os.environ.get("CLOD_YARDSTICK", ROOT.parent / "shared" / "yardstick"))
THREADS = 2
WARM = 2
REPEATS = 15
SHARES = (1.0, 0.5, 0.25, 0.1)
SMALL = workloads.Size(3000, 160, 107, 1)  # of the comparison in float64
Jobs = dict[str, Callable[[], Any]]
JOBS: Jobs = {}  # of a worker's process


def main():
    parser = arguments(__doc__, record=FILE)
    parser.add_argument(
        "--accuracy", action="store_true", help="agreement with float64 instead of times"
    )
    args = parser.parse_args()
    torch.set_num_threads(THREADS)
    kind = "accuracy" if args.accuracy else "speed"
    for row in accuracy() if args.accuracy else speed():
        append(FILE, {"kind": kind, **row}, args.record)


def page_table():
    """Milliseconds of ours, and in brackets of the yardstick."""
    found = last(FILE, "workload", kind="speed")
    heads, lines = [""], {"forward": ["forward"], "both": ["forward + backward"]}
    for (name,), row in found.items():
        size = workloads.SIZES[name]
        heads.append(f"{name}: {size.count:,} at {size.width}x{size.height}")
        for part, line in lines.items():
            line.append(f"{row[f'{part}_ms']:.3g} (C++ {row[f'yardstick_{part}_ms']:.3g})")
    return Table(heads, lines.values(), found.values())


def speed():
    """All times of each workload."""
    with tempfile.TemporaryDirectory() as folder:
        library, rows = build_yardstick(YARDSTICK, Path(folder)), []
        for name, size in workloads.SIZES.items():
            workers = {"": worker(our_jobs, size)}
            if library:
                workers["yardstick_"] = worker(yardstick_jobs, size, library)
            steps = {"": [], "yardstick_": []}
            for _ in range(REPEATS + WARM):
                for who, pool in workers.items():
                    steps[who].append(pool.submit(_run, "step").result())
            frames = [workers[""].submit(_run, "frames").result() for _ in range(REPEATS + WARM)]
            row = {
                "workload": name,
                "gaussians": size.count,
                "width": size.width,
                "height": size.height,
                "repeats": REPEATS,
            }
            for who, times in steps.items():
                row[f"{who}forward_ms"] = middle([forward for forward, _ in times])
                row[f"{who}both_ms"] = middle([both for _, both in times])
            row["kept"] = [
                {"share": share, "ms": middle(times)}
                for share, times in zip(SHARES, zip(*frames, strict=True), strict=True)
            ]
            rows.append(row | {"render_ms": row["kept"][0]["ms"]})
            for pool in workers.values():
                pool.shutdown()
    return rows


def worker(make, *given):
    """A process of its own: the yardstick's library, for example, makes its process flush denormal
    numbers.
    """
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=spawn, initializer=_start, initargs=(make, *given))


def _start(make, *given):
    torch.set_num_threads(THREADS)
    JOBS.update(make(*given))


def _run(job):
    return JOBS[job]()


def middle(times):
    """The median without the first repeats."""
    return round(median(times[WARM:]), 2) if times[WARM:] else None


def our_jobs(size):
    """A step; and frames of the most opaque, with opacities 0 of the others, as the dial does."""
    workload = workloads.make(size)
    draw, leaves = ours(workload)
    rank = workload.opacities.argsort(descending=True).argsort()
    kept = [rank < share * len(rank) for share in SHARES]
    fewer = (replace(workload, opacities=workload.opacities.where(rows, 0)) for rows in kept)
    frames = [ours(part)[0] for part in fewer]
    return {
        "step": lambda: timed_step(draw, leaves, workload.weights),
        "frames": lambda: [timed_frame(frame) for frame in frames],
    }


def ours(workload):
    """A function that draws the workload with our rasterizer, and the leaves of its gradients."""
    leaves = {name: value.clone().requires_grad_() for name, value in workload.parameters().items()}
    draw = partial(cpu.rasterize, **leaves, camera=workload.camera, background=torch.zeros(3))
    return lambda: draw()[0], list(leaves.values())


def timed_step(draw, leaves, weights):
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
def timed_frame(draw):
    began = time.perf_counter()
    draw()
    return (time.perf_counter() - began) * 1e3


def yardstick_jobs(size, library):
    binding = load_module(YARDSTICK / "binding.py")
    kernel = binding.Lib(str(library), THREADS)
    workload = workloads.make(size)
    camera = workload.camera
    leaves = {
        field: getattr(workload, field).clone().requires_grad_() for field in workloads.FIELDS
    }
    pose = {"viewmat": camera.viewmat, "K": camera.K}
    scene = {**leaves, **pose, "W": camera.width, "H": camera.height}

    def draw():
        return binding.render(kernel, scene)[0]

    return {"step": lambda: timed_step(draw, list(leaves.values()), workload.weights)}


def build_yardstick(source, folder):
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
        different = workloads.differences(workloads.make(size), theirs.make(*size))
        if different:
            sys.exit(f"{name} is not the yardstick's: {', '.join(different)} differ")
    library = folder / "libyardstick.so"
    options = "-O3 -march=native -ffast-math -std=c++17 -fopenmp -shared -fPIC -DTS=32"
    subprocess.run(["g++", *options.split(), source / "kernel.cpp", "-o", library], check=True)
    return library


def load_module(path):
    """A module from a file that is not on the path."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def accuracy():
    """Image and gradients of a small room against ``rasterizers/reference.py`` in float64; and one
    thread against two.

    Float32 rounding may decide otherwise whether an alpha reaches 1/255 or a pixel ends: those
    pixels are ``flipped``.
    """
    scene = workloads.make(SMALL)
    exact, expected = differentiate(scene, reference.rasterize, torch.float64)
    image, gradients = differentiate(scene, cpu.rasterize, torch.float32)
    torch.set_num_threads(1)
    single, alone = differentiate(scene, cpu.rasterize, torch.float32)
    error = (image - exact).abs().amax(-1)
    flipped = error > 1e-4
    alike = torch.equal(single, image)
    errors = {}
    for name, gradient in gradients.items():
        errors[name] = ((gradient - expected[name]).norm() / expected[name].norm()).item()
        alike &= torch.equal(alone[name], gradient)
    return [
        {
            "workload": "small",
            "gaussians": len(scene.means),
            "pixels": error.numel(),
            "flipped": int(flipped.sum()),
            "error": error[~flipped].max().item(),
            "gradient_errors": errors,
            "one_thread_alike": alike,
        }
    ]


def differentiate(scene, draw, dtype):
    """The image, and the gradients of its weighted sum."""
    leaves = {name: value.to(dtype).requires_grad_() for name, value in scene.parameters().items()}
    image = draw(**leaves, camera=scene.camera, background=torch.zeros(3, dtype=dtype))[0]
    gradients = torch.autograd.grad((image * scene.weights).sum(), list(leaves.values()))
    return image.detach(), dict(zip(leaves, gradients, strict=True))


if __name__ == "__main__":
    main()
