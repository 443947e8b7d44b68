"""All checks for an NVIDIA GPU in one command; with small sizes they also run on the CPU.

    # needs torch with CUDA, gsplat 1.5.3 and the shared data
    python benchmarks/gpu.py
    python benchmarks/gpu.py --device cpu --small    # the same code, in seconds

``tests``: the contract of every backend, the gsplat integration and the optimizer.
``plush``: plush_half adapted on the GPU and on the CPU with the same settings: seconds, and
held-out quality.
``city``: a synthetic city adapted (peak memory), then near and far frames in turn with plain gsplat
on the same file: times, the dial's share, PSNR.

Each adds rows to ``results/gpu.jsonl``. Without a GPU, plain is this package's CPU rasterizer
without the dial.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Any

import clod_adapter as clod
from city import city, city_cameras, perturb
from clod_adapter.equation.attenuation import dial
from clod_adapter.losses import psnr
from clod_adapter.rasterizers import cuda, wait_for
from clod_adapter.render import splat
from common import ROOT, Row, append, arguments, checkpoint, outcomes, photographs, quality

import torch
from torch import Tensor

DIALS = (1.0, 3.0, 7.0)
TESTS = (
    "tests/rasterizers",
    "tests/integrations/test_gsplat.py",
    "tests/test_consumers.py",
    "tests/training/test_step.py",
)


@dataclass(frozen=True)
class Size:
    """How large everything is."""

    count: int = 6_000_000  # Gaussians of the city
    width: int = 1600  # of its pictures
    height: int = 1066
    views: int = 24  # to train on, and as many to test
    steps: int = 300  # of the city's adaptation
    plush_steps: int | None = None  # of plush_half's; None: the default
    repeats: int = 30  # of each timed frame


SMALL = Size(count=3000, width=64, height=48, views=4, steps=3, plush_steps=3, repeats=2)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument(
        "--small",
        action="store_true",
        help="a tiny city, also in place of plush_half, and few tests",
    )
    parser.add_argument("--only", nargs="+", choices=CHECKS, default=list(CHECKS))
    parser.add_argument("--count", type=int, help="Gaussians of the city")
    parser.add_argument("--results", default="gpu.jsonl", help="the file, in results/ or anywhere")
    args = parser.parse_args()
    if args.device == "cuda":
        if not torch.cuda.is_available():
            sys.exit("torch sees no GPU here: give --device cpu --small to try the script")
        if reason := cuda.unusable():
            sys.exit(reason)
    size = SMALL if args.small else Size()
    size = replace(size, count=args.count or size.count)
    for name in args.only:
        about = {"benchmark": f"gpu {name}", "device": args.device, "size": asdict(size)}
        for row in CHECKS[name](torch.device(args.device), size, args.small):
            append(args.results, {**about, **row})


def run_tests(device: torch.device, size: Size, small: bool) -> list[Row]:
    """Counts of all, failed and skipped tests, and the names of failed ones."""
    few = ["-k", "test_for_device or test_no_gaussians"] if small else []
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        options = ["-p", "no:xdist", "-q", f"--junitxml={report}"]
        subprocess.run(
            [sys.executable, "-m", "pytest", *options, *TESTS, *few],
            cwd=ROOT,
            stdout=sys.stderr,
            check=False,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        counts = outcomes(report)
    cases = counts.pop("passed") + counts["failed"] + counts["skipped"]
    return [{"cases": cases, **counts, "seconds": round(time.perf_counter() - began, 1)}]


def adapt_plush(device: torch.device, size: Size, small: bool) -> list[Row]:
    """A row a device."""
    if small:
        base, scene = synthetic(size, torch.device("cpu"))
    else:
        base, scene = checkpoint("plush_half").gaussians, photographs("plush_half")
    config = clod.AdaptConfig(iters=size.plush_steps)
    rows = []
    for place in dict.fromkeys([device, torch.device("cpu")]):
        gaussians = base.to(place)
        # compiled before the clock starts
        clod.adapt(gaussians, clod.Scene(scene.train[:1], ()), clod.AdaptConfig(iters=1))
        model, cost = timed_adapt(gaussians, scene, config)
        (base_row,) = quality(gaussians, scene.test, 1.0)
        rows.append(
            {
                "on": place.type,
                "scene": "synthetic" if small else "plush_half",
                "count": len(gaussians),
                **cost,
                "base": base_row,
                "rows": quality(model, scene.test, [1.0, 3.0, config.max_sv]),
            }
        )
    return rows


def timed_adapt(
    base: clod.Gaussians, scene: clod.Scene, config: clod.AdaptConfig
) -> tuple[clod.Gaussians, Row]:
    device = base.means.device
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    adapted = clod.adapt(base, scene, config)
    wait_for(device)
    cost = {
        "config": asdict(config),
        "start_seconds": round(adapted.start_seconds, 2),
        "train_seconds": round(adapted.seconds, 3),
        "peak_bytes": peak(device),
    }
    return adapted.gaussians, cost


def measure_city(device: torch.device, size: Size, small: bool) -> list[Row]:
    """A row for the adaptation, and one for each of near and far at each dial value."""
    base, scene = synthetic(size, device)
    base = base.to(device)
    config = clod.AdaptConfig(iters=size.steps, max_sv=DIALS[-1])
    model, cost = timed_adapt(base, scene, config)
    base_bytes = sum(tensor.nbytes for tensor in base.tensors().values())
    rows = [{"what": "adapt", **cost, "base_bytes": base_bytes}]
    del base
    truth = city(size.count)
    for where in ("near", "far"):
        cameras = city_cameras(4, size.width, size.height, where=where, count=size.count, seed=9)
        targets = photograph(truth, cameras, device)
        rows += [frames(model, targets, where, s, size.repeats) for s in DIALS]
    return rows


@torch.no_grad()
def frames(
    model: clod.Gaussians, views: list[clod.View], where: str, s: float, repeats: int
) -> Row:
    """Medians in milliseconds, ours and plain in turn, over the views; and PSNR of the pictures."""
    device = model.means.device
    plain = plain_frame(model)
    jobs: dict[str, Callable[[clod.Camera], Any]] = {
        "ours": lambda camera: clod.render(model, camera, s).image,
        "plain": plain,
        "dial": lambda camera: dial(model, camera, s),
    }
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job(views[0].camera)  # compiled and warm
    for k in range(repeats):
        camera = views[k % len(views)].camera
        for name, job in jobs.items():
            wait_for(device)
            began = time.perf_counter()
            job(camera)
            wait_for(device)
            times[name].append((time.perf_counter() - began) * 1e3)
    ms = {name: median(taken) for name, taken in times.items()}
    kept, psnr_full, psnr_truth = [], [], []
    for view in views:
        frame = clod.render(model, view.camera, s)
        full = (plain(view.camera).clamp(0, 1) * 255).round().to(torch.uint8).cpu()
        kept.append(int(frame.kept.sum()))
        psnr_full.append(psnr(frame.image, full))
        psnr_truth.append(psnr(frame.image, view.image))
    return {
        "what": "frames",
        "where": where,
        "virtual_scale": s,
        "kept": fmean(kept),
        "ms": ms,
        "faster": {"plain": ms["plain"] / ms["ours"]},
        "dial_share": ms["dial"] / ms["ours"],
        "psnr_full": fmean(psnr_full),
        "psnr_truth": fmean(psnr_truth),
    }


def plain_frame(model: clod.Gaussians) -> Callable[[clod.Camera], Tensor]:
    """The file without its dial, activated beforehand, as a viewer that does not know the dial
    draws it.
    """
    scales, opacities = model.scales, model.opacities
    if model.means.device.type == "cpu":
        return lambda camera: splat(model, opacities, camera)[0]
    import gsplat

    colors = torch.cat([model.sh0, model.shN], 1)

    return lambda camera: gsplat.rasterization(
        model.means,
        model.quats,
        scales,
        opacities,
        colors,
        camera.viewmat.to(scales)[None],
        camera.K.to(scales)[None],
        camera.width,
        camera.height,
        near_plane=camera.near,
        sh_degree=model.sh_degree,
    )[0][0]


def synthetic(size: Size, device: torch.device) -> tuple[clod.Gaussians, clod.Scene]:
    """A perturbed city, and photographs of the unperturbed one."""
    truth = city(size.count)
    cameras = city_cameras(2 * size.views, size.width, size.height, where="mixed", count=size.count)
    views = photograph(truth, cameras, device)
    return perturb(truth), clod.Scene(tuple(views[: size.views]), tuple(views[size.views :]))


@torch.no_grad()
def photograph(
    truth: clod.Gaussians, cameras: list[clod.Camera], device: torch.device
) -> list[clod.View]:
    truth = truth.to(device)
    return [clod.View(camera, clod.render(truth, camera).pixels.cpu()) for camera in cameras]


def peak(device: torch.device) -> int:
    """Bytes: of torch's allocations on a GPU since the last reset; on the CPU of the process,
    ever.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


CHECKS: dict[str, Callable[[torch.device, Size, bool], list[Row]]] = {
    "tests": run_tests,
    "plush": adapt_plush,
    "city": measure_city,
}


if __name__ == "__main__":
    main()
