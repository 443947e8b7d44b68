"""All checks for an NVIDIA GPU in one command; with small sizes they also run on the CPU.

    # needs torch with CUDA, gsplat 1.5.3 and the shared data
    python benchmarks/gpu.py
    python benchmarks/gpu.py --device cpu --small    # the same code, in seconds

``tests``: the contract of every backend, the gsplat integration and the optimizer.
``plush``: plush_half adapted on the GPU and on the CPU with the same settings: seconds, and
held-out quality.
``city``: a synthetic city adapted (peak memory), then near and far frames, in turn with those of
the same file without its dial: times and PSNR.

Each adds rows to ``results/gpu.jsonl``.
"""

import resource
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass

import clod_adapter as clod
import portability
from city import city, city_cameras, perturb
from clod_adapter.evaluation.frame_times import time_frames
from clod_adapter.rasterizers import cuda, wait_for
from common import Row, append, arguments, checkpoint, photographs, quality

import torch

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


SMALL = Size(count=1000, width=64, height=48, views=4, steps=3, plush_steps=3)


def main():
    parser = arguments(__doc__)
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument(
        "--small",
        action="store_true",
        help="a tiny city, also in place of plush_half, and few tests",
    )
    parser.add_argument("--only", nargs="+", choices=CHECKS, default=list(CHECKS))
    parser.add_argument("--results", default="gpu.jsonl", help="the file, in results/ or anywhere")
    args = parser.parse_args()
    if args.device == "cuda":
        if not torch.cuda.is_available():
            sys.exit("torch sees no GPU here: give --device cpu --small to try the script")
        if reason := cuda.unusable():
            sys.exit(reason)
    size = SMALL if args.small else Size()
    for name in args.only:
        about = {"benchmark": f"gpu {name}", "device": args.device, "size": asdict(size)}
        for row in CHECKS[name](torch.device(args.device), size, args.small):
            append(args.results, {**about, **row})


def run_tests(device, size, small):
    """Counts of passed, failed and skipped tests, and the names of failed ones."""
    return [portability.run("plain", TESTS[-1:] if small else TESTS)]


def adapt_plush(device, size, small):
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


def timed_adapt(base, scene, config):
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


def measure_city(device, size, small):
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
        rows += frames(model, targets, where)
    return rows


def frames(model, views, where):
    """Milliseconds of the dial values and of the file without its dial, in turn over the views; and
    PSNR of the pictures, against the truth and against that file.
    """
    plain = clod.detach(model)
    cameras = [view.camera for view in views]
    taken = time_frames([(model, DIALS), (plain, (1.0,))], cameras)
    times, (without,) = taken.milliseconds
    full = photograph(plain, cameras, model.means.device)
    measured = zip(times, quality(model, views, DIALS), quality(model, full, DIALS), strict=True)
    rows = []
    for ms, row, of_full in measured:
        milliseconds = {"ours": ms, "plain": without}
        row |= {"what": "frames", "where": where, "ms": milliseconds, "psnr_full": of_full["psnr"]}
        rows.append(row)
    return rows


def synthetic(size, device):
    """A perturbed city, and photographs of the unperturbed one."""
    truth = city(size.count)
    cameras = city_cameras(2 * size.views, size.width, size.height, where="mixed", count=size.count)
    views = photograph(truth, cameras, device)
    return perturb(truth), clod.Scene(tuple(views[: size.views]), tuple(views[size.views :]))


@torch.no_grad()
def photograph(truth, cameras, device):
    truth = truth.to(device)
    return [clod.View(camera, clod.render(truth, camera).pixels.cpu()) for camera in cameras]


def peak(device):
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
