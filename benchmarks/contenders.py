"""The rasterizers that ``rasterize.py`` times, each in its own process: this package and the yardstick."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import multiprocessing
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import workloads
from clod_adapter.rasterizers import cpu
from workloads import Workload

import torch
from torch import Tensor

THREADS = 2
SHARES = (1.0, 0.5, 0.25, 0.1)
FEW = slice(100)  # rows that libraries are loaded and warmed with
Jobs = dict[str, Callable[[], Any]]
JOBS: Jobs = {}  # of a worker's process


class Worker:
    """A rasterizer in a process of its own, so that its libraries and memory do not affect the others.

    The yardstick's library, for example, makes its process flush denormal numbers. A dead worker returns None.
    """

    def __init__(self, make: Callable[..., Jobs], *arguments: Any) -> None:
        spawn = multiprocessing.get_context("spawn")
        self.pool = ProcessPoolExecutor(1, mp_context=spawn, initializer=_start, initargs=(make, *arguments))

    def __call__(self, job: str) -> Any:
        try:
            return self.pool.submit(_run, job).result()
        except BrokenProcessPool:
            return None


def _start(make: Callable[..., Jobs], *arguments: Any) -> None:
    torch.set_num_threads(THREADS)
    JOBS.update(make(*arguments))
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)  # memory that is free already must not hide that of the steps
    before = _memory("VmRSS")
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak starts anew
    JOBS["memory"] = lambda: before and round(_memory("VmHWM") - before)


def _run(job: str) -> Any:
    return JOBS[job]()


def _memory(field: str) -> float:
    """Megabytes of a field of /proc/self/status; 0 where there is none."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(field):
                return int(line.split()[1]) / 1024
    return 0.0


def timed_step(draw: Callable[[], Tensor], leaves: list[Tensor], weights: Tensor) -> list[float]:
    """Milliseconds of the forward part and of a whole step: all gradients of a weighted sum of the pixels."""
    for leaf in leaves:
        leaf.grad = None
    began = time.perf_counter()
    image = draw()
    drawn = time.perf_counter()
    (image * weights).sum().backward()
    return [(drawn - began) * 1e3, (time.perf_counter() - began) * 1e3]


def ours(workload: Workload) -> tuple[Callable[[], Tensor], list[Tensor]]:
    """A function that draws the workload with our rasterizer, and the leaves of its gradients."""
    leaves = {name: value.clone().requires_grad_() for name, value in workload.parameters().items()}
    background = torch.zeros(3)
    return lambda: cpu.rasterize(**leaves, camera=workload.camera, background=background)[0], list(leaves.values())


@torch.no_grad()
def timed_frame(draw: Callable[[], Tensor]) -> float:
    """Milliseconds of a frame without gradients."""
    began = time.perf_counter()
    draw()
    return (time.perf_counter() - began) * 1e3


def our_jobs(name: str) -> Jobs:
    """A step, a frame, and frames of fewer Gaussians."""
    workload = workloads.make(name)
    timed_step(*ours(workload.changed("", FEW)), workload.weights)
    draw, leaves = ours(workload)
    fewer: list[Callable[[], Tensor]] = []

    def kept() -> list[float]:
        fewer.extend([] if fewer else (ours(part)[0] for part in _fewer(workload)))
        return [timed_frame(one) for one in fewer]

    return {
        "step": lambda: timed_step(draw, leaves, workload.weights), "frame": lambda: timed_frame(draw), "kept": kept
    }  # fmt: skip


def _fewer(workload: Workload) -> list[Workload]:
    """The most opaque of SHARES: the others' rows removed, then the others' opacities set to 0 as the dial does."""
    rank = workload.opacities.argsort(descending=True).argsort()
    keep = [rank < share * len(rank) for share in SHARES]
    removed = [workload.changed("", rows) for rows in keep]
    return removed + [workload.changed("", opacities=torch.where(rows, workload.opacities, 0)) for rows in keep]


def yardstick_jobs(name: str, folder: Path, library: Path) -> Jobs:
    """A step, and how many pairs of Gaussian and pixel it blends."""
    binding, workload = load_module(folder / "binding.py"), workloads.make(name)
    kernel = binding.Lib(str(library), THREADS)

    def step_of(part: Workload) -> Callable[[], list[float]]:
        fields = ("means", "scales", "quats", "opacities", "sh")
        leaves = {field: getattr(part, field).clone().requires_grad_() for field in fields}
        camera = part.camera
        scene = {**leaves, "viewmat": camera.viewmat, "K": camera.K, "W": camera.width, "H": camera.height}
        return lambda: timed_step(lambda: binding.render(kernel, scene)[0], list(leaves.values()), part.weights)

    step_of(workload.changed("", FEW))()
    return {"step": step_of(workload), "pairs": lambda: int(kernel.count()[0])}


def build_yardstick(source: Path, folder: Path) -> Path | None:
    """The yardstick's library, built as its ``measure.py`` does; None where its source or g++ is absent.

    Exits with a message where its scenes differ from ours.
    """
    if not (source / "kernel.cpp").is_file() or not shutil.which("g++"):
        print(f"the yardstick is left out: there is no {source / 'kernel.cpp'}, or no g++", file=sys.stderr)
        return None
    theirs = load_module(source / "workload.py")
    for name, size in workloads.SIZES.items():
        different = workloads.differences(workloads.make(name), theirs.make(*size))
        if different:
            sys.exit(f"{name} is not the yardstick's: {', '.join(different)} differ")
    library = folder / "libyardstick.so"
    options = ["-O3", "-march=native", "-ffast-math", "-std=c++17", "-fopenmp", "-shared", "-fPIC", "-DTS=32"]
    subprocess.run(["g++", *options, str(source / "kernel.cpp"), "-o", str(library)], check=True)
    return library


def load_module(path: Path) -> Any:
    """A module from a file that is not on the path."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
