"""Checks of the optional tools (figures, formats, metrics, browser) and of the machine (cores, memory, cache)."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import TYPE_CHECKING

from clod_adapter._support.text import first_line
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.folder import user_caches

from ..shared.browsers import find_browser
from .checks import CheckFailed, Probe
from .reference_scene import ReferenceScene

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

CGROUP = Path("/sys/fs/cgroup")
MEMINFO = Path("/proc/meminfo")
TORCHVISION = "pip install --force-reinstall torchvision"


def plots() -> str:
    """matplotlib draws a figure in the reports' style."""
    from clod_adapter.report.style import INSTALL, new_figure

    try:
        import matplotlib

        with new_figure((1, 1)) as figure, TemporaryFile() as file:
            figure.subplots().plot([0, 1])
            figure.savefig(file, format="png")
    except ImportError as error:
        raise CheckFailed(f"matplotlib cannot be imported ({first_line(error)})", INSTALL) from error
    return f"matplotlib {matplotlib.__version__}"


def glb() -> str:
    """Writes a file and reads it."""
    from clod_adapter.io.checkpoint import load
    from clod_adapter.io.file_formats import write

    gaussians = _gaussians()
    try:
        with TemporaryDirectory() as folder:
            write(Path(folder) / "a.glb", gaussians)
            again = load(Path(folder) / "a.glb").gaussians
    except ClodError as error:
        raise CheckFailed("pygltflib is not installed", "pip install pygltflib") from error
    if not again.means.equal(gaussians.means):
        raise CheckFailed("the file read differs from the file written", "pip install --upgrade pygltflib")
    return "writes and reads .glb"


def splat_transform() -> str:
    """splat-transform packs a file."""
    from clod_adapter.io.file_formats import write
    from clod_adapter.io.formats.splat_transform import HELP, SplatTransform

    try:
        tool = SplatTransform.find()
        with TemporaryDirectory() as folder:
            write(Path(folder) / "a.ply", _gaussians())
            tool.run(Path(folder) / "a.ply", Path(folder) / "b.compressed.ply", timeout=20.0)
    except ClodError as error:
        raise CheckFailed(str(error).removesuffix(HELP).rstrip("; "), HELP) from error
    return f"{tool.version}, {'on a GPU' if tool.gpu else 'without a GPU'}"


def metric(name: str) -> Probe:
    """A probe that measures the distance of an image to itself and to another."""

    def probe() -> str:
        import torch

        from clod_adapter.evaluation.perceptual import METRICS, Unavailable

        photograph = torch.randint(0, 256, (64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
        try:
            measure = METRICS[name]()
        except Unavailable as reason:
            raise CheckFailed(reason.found, reason.fix or TORCHVISION) from reason
        same, other = measure(photograph / 255, photograph), measure(1 - photograph / 255, photograph)
        if not 0 <= same < 0.01 < other:
            raise CheckFailed(f"measures {same:.2g} for equal images and {other:.2g} for others", TORCHVISION)
        return "works"

    return probe


def browser() -> str:
    """Finds a browser without opening it."""
    found = find_browser()
    if found is None:
        raise CheckFailed(
            "none found that opens a window",
            "clod-adapt view --no-browser --port 8000, and ssh -L 8000:127.0.0.1:8000 HOST on a machine with a browser",
        )
    return str(getattr(found, "name", "") or type(found).__name__)


def cores() -> str:
    """The cores that this process may use; torch must not use more threads."""
    allowed = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    quota = _cgroup("cpu.max", lambda said: int(said.split()[0]) / int(said.split()[1]))
    usable = allowed if quota is None else min(allowed, max(1, round(quota)))
    torch = sys.modules.get("torch")  # the check of torch reports its errors
    if torch is not None and (threads := torch.get_num_threads()) > usable:
        raise CheckFailed(f"{threads} threads on {usable} cores", f"OMP_NUM_THREADS={usable} clod-adapt ...")
    return f"{usable} of {os.cpu_count()}"


def memory() -> str:
    """Free and total memory, within a container's limit."""
    total, free = _memory()
    limit = _cgroup("memory.max", int)
    used = _cgroup("memory.current", int)
    if limit is not None and used is not None and limit < total:
        total, free = limit, min(free, limit - used)
    return f"{free / 2**30:.1f} GB free of {total / 2**30:.1f} GB"


def _memory() -> tuple[float, float]:
    """Total and available bytes."""
    if MEMINFO.is_file():
        rows = dict(line.split(":") for line in MEMINFO.read_text().splitlines())
        return int(rows["MemTotal"].split()[0]) * 1024, int(rows["MemAvailable"].split()[0]) * 1024
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        raise CheckFailed("unknown on this system", "see the task manager")
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return total, total


def _cgroup(name: str, read: Callable[[str], float]) -> float | None:
    """A limit of this process's container; None where there is none."""
    with contextlib.suppress(OSError, ValueError):  # absent, or "max"
        return read((CGROUP / name).read_text())
    return None


def cache() -> str:
    """The folders of undistorted photographs, where a file is written, and of compiled kernels."""
    try:
        folder = user_caches() / "clod-adapter"
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder) as file:
            file.write(bytes(1024))
    except (OSError, ClodError) as error:
        reason = f"{folder}: {error.strerror}" if isinstance(error, OSError) else str(error)
        raise CheckFailed(f"not writable ({reason})", "set XDG_CACHE_HOME to a writable folder") from error
    from clod_adapter._kernels import blend

    kept = getattr(blend.blend._cache, "cache_path", None)
    if kept is None:
        raise CheckFailed("compiled kernels cannot be cached", "set NUMBA_CACHE_DIR to a writable folder")
    return f"{folder}; kernels in {kept}"


def _gaussians() -> Gaussians:
    from clod_adapter.gaussians import Gaussians

    given = ReferenceScene.make().arguments
    return Gaussians(
        means=given["means"], quats=given["quats"], log_scales=given["scales"].log(), sh0=given["sh0"],
        shN=given["shN"], opacity_logits=given["opacities"].logit(),
    )  # fmt: skip


TOOLS: dict[str, Probe] = {
    "plots": plots, "glb": glb, "splat-transform": splat_transform, "lpips": metric("lpips"),
    "flip": metric("flip"), "browser": browser, "cores": cores, "memory": memory, "cache": cache,
}  # fmt: skip
