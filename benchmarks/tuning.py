"""Plain tuning of a splat on photographs, without a dial, and merging by
``splat-transform --decimate`` (NanoGS).
"""

import os
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import clod_adapter as clod
from clod_adapter._kernels.threads import torch_on_one_thread
from clod_adapter.adapter import ATTRIBUTES, detach
from clod_adapter.cameras import camera_extent
from clod_adapter.initialization.importance import removal_error
from clod_adapter.io.formats.splat_transform import SplatTransform
from clod_adapter.losses import photometric_loss
from clod_adapter.render import splat
from clod_adapter.training.optimizer import RowAdam
from common import CACHE, ROOT

import numpy as np
import torch
from tqdm import tqdm

TIMEOUT = 3600.0  # seconds of a merging
# 3DGS's rates of training; means times the cameras' extent.
RATES = {
    "means": 1.6e-4,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "opacity_logits": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """The settings of a tuning."""

    iters: int  # steps, over which the learning rates fall exponentially to ``final`` of RATES
    seed: int = 0  # of the order of the views, and of the prefixes' lengths
    final: float = 0.05
    prefixes: bool = False  # a prefix's share of all is log-uniform in [shortest, 1]
    shortest: float = 0.01


def tune(start, views, config):
    """Minimises 0.8 L1 + 0.2 (1 - SSIM), a view a step, with Adam over all attributes; the result,
    and seconds.

    With ``prefixes`` each step's loss is that of all Gaussians plus that of a random prefix of
    them, after Matryoshka Gaussian Splatting (arXiv 2603.19234): two renders a step, no weights.
    ``start`` is then in the order of importance. Drawn with the screen-space filter of ``start``.
    """
    start = detach(start)
    copied = {"dtype": torch.float32, "copy": True, "memory_format": torch.contiguous_format}
    parameters = {name: getattr(start, name).detach().to(**copied) for name in ATTRIBUTES}
    rates = RATES | {"means": RATES["means"] * camera_extent([view.camera for view in views])}
    tuned = [name for name in ATTRIBUTES if parameters[name].numel()]
    optimizer = RowAdam({name: parameters[name] for name in tuned})
    random = np.random.default_rng(config.seed)
    all_rows = torch.ones(len(start), dtype=torch.bool)
    order = []
    prefix = len(start) if config.prefixes else None
    _gradients(start, parameters, tuned, views[0], prefix)  # compiled before the clock starts
    began = time.perf_counter()
    for step in tqdm(range(config.iters), leave=False):
        order = order or random.permutation(len(views)).tolist()
        if config.prefixes:
            prefix = max(round(config.shortest ** random.random() * len(start)), 1)
        gradients = _gradients(start, parameters, tuned, views[order.pop()], prefix)
        share = config.final ** (step / config.iters)
        optimizer.step(gradients, all_rows, {name: rate * share for name, rate in rates.items()})
    return start.replace(**parameters), time.perf_counter() - began


@torch_on_one_thread()
def _gradients(start, parameters, tuned, view, prefix):
    leaves = {
        name: value.detach().requires_grad_(name in tuned) for name, value in parameters.items()
    }
    gaussians = start.replace(**leaves)
    loss = photometric_loss(splat(gaussians, gaussians.opacities, view.camera)[0], view.image)
    if prefix is not None:
        # The rasterizer drops Gaussians of opacity 0 first.
        inside = torch.arange(len(gaussians)) < prefix
        image, _ = splat(gaussians, torch.where(inside, gaussians.opacities, 0), view.camera)
        loss = loss + photometric_loss(image, view.image)
    gradients = torch.autograd.grad(loss, [leaves[name] for name in tuned])
    return dict(zip(tuned, gradients, strict=True))


def by_importance(gaussians, views):
    """The Gaussians by falling removal error, equal ones in their order."""
    cameras = [view.camera for view in views]
    return gaussians[removal_error(gaussians, cameras).argsort(descending=True, stable=True)]


def find_tool():
    """splat-transform of ``make peers``, or on the PATH, without a GPU; exits where it is missing
    or too old.
    """
    place = str(ROOT / ".venv" / "peers" / "node_modules" / ".bin")
    # also for the commands that a benchmark starts
    if place not in os.environ["PATH"].split(os.pathsep):
        os.environ["PATH"] = os.pathsep.join([place, os.environ["PATH"]])
    try:
        return replace(SplatTransform.find(), gpu=False)
    except clod.ClodError as error:
        sys.exit(str(error))


MERGINGS = ("--decimate-adaptive", "--decimate")


def merge(base, count, method):
    """The base merged to ``count`` Gaussians, and the seconds that the tool took, then or now.

    Args:
        method: of MERGINGS.
    """
    tool = find_tool()
    CACHE.mkdir(parents=True, exist_ok=True)
    out = CACHE / f"{base.fingerprint[:12]}-{tool.version}{method}-{count}.ply"
    clock = out.with_suffix(".seconds")
    if not (out.exists() and clock.exists()):
        # In a folder of its own: another benchmark may want the same file now.
        with tempfile.TemporaryDirectory(dir=CACHE) as folder:
            merged = Path(folder) / "merged.ply"
            try:
                seconds = tool.run("-q", base.path, method, str(count), merged, timeout=TIMEOUT)
            except clod.ClodError as error:
                sys.exit(str(error))
            clock.write_text(f"{seconds:.2f}\n", encoding="utf-8")
            merged.replace(out)
    return clod.load(out).gaussians, float(clock.read_text(encoding="utf-8"))
