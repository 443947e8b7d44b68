"""What is optional, and what the machine has: pictures, formats, metrics, a browser, memory. Each look does it."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import TYPE_CHECKING

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.folder import user_caches

from ..shared.browsers import find_browser
from ..shared.findings import Look, Miniature, Off, first_line

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

CGROUP = Path("/sys/fs/cgroup")
MEMINFO = Path("/proc/meminfo")
TORCHVISION = "pip install --force-reinstall torchvision"


def plots() -> str:
    """A figure in the reports' style."""
    from clod_adapter.report.style import INSTALL, new_figure

    try:
        import matplotlib

        with new_figure((1, 1)) as figure, TemporaryFile() as file:
            figure.subplots().plot([0, 1])
            figure.savefig(file, format="png")
    except ImportError as error:
        raise Off(f"matplotlib cannot be imported ({first_line(error)})", INSTALL) from error
    return f"matplotlib {matplotlib.__version__}"


def glb() -> str:
    """A file is written and read again."""
    from clod_adapter.io.checkpoint import load
    from clod_adapter.io.file_formats import write

    gaussians = _gaussians()
    try:
        with TemporaryDirectory() as folder:
            write(Path(folder) / "a.glb", gaussians)
            again = load(Path(folder) / "a.glb").gaussians
    except ClodError as error:
        raise Off("pygltflib is not installed", "pip install 'clod-adapter[export]'") from error
    if not again.means.equal(gaussians.means):
        raise Off("a file that was written reads as another", "pip install --upgrade 'clod-adapter[export]'")
    return "writes and reads .glb"


def splat_transform() -> str:
    """A file is packed."""
    from clod_adapter.io.file_formats import write
    from clod_adapter.io.formats.splat_transform import HELP, SplatTransform

    try:
        tool = SplatTransform.find()
        with TemporaryDirectory() as folder:
            write(Path(folder) / "a.ply", _gaussians())
            tool.run(Path(folder) / "a.ply", Path(folder) / "b.compressed.ply", timeout=20.0)
    except ClodError as error:
        raise Off(str(error).removesuffix(HELP).rstrip("; "), HELP) from error
    return f"{tool.version}, {'on a GPU' if tool.gpu else 'without a GPU'}"


def demo() -> str:
    """One of the demo's photographs."""
    from clod_adapter.demo.textures import photograph

    try:
        photograph("coffee.png")
    except ClodError as error:
        raise Off(first_line(error).partition(": pip")[0], "pip install 'clod-adapter[demo]'") from error
    return "its photographs are there"


def metric(name: str) -> Look:
    """The distance of a picture to itself, and to another."""

    def look() -> str:
        import torch

        from clod_adapter.evaluation.perceptual import METRICS, Unavailable

        photograph = torch.randint(0, 256, (64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
        try:
            measure = METRICS[name]()
        except Unavailable as reason:
            raise Off(reason.found, reason.fix or TORCHVISION) from reason
        same, other = measure(photograph / 255, photograph), measure(1 - photograph / 255, photograph)
        if not 0 <= same < 0.01 < other:
            raise Off(f"measures {same:.2g} of equal pictures and {other:.2g} of others", TORCHVISION)
        return "measures"

    return look


def browser() -> str:
    """Found and not opened, as a window of its own is no answer."""
    found = find_browser()
    if found is None:
        raise Off(
            "none that opens a window",
            "clod-adapt view --no-browser --port 8000, and on the machine with one ssh -L 8000:127.0.0.1:8000 HOST",
        )
    return str(getattr(found, "name", "") or type(found).__name__)


def cores() -> str:
    """Those this process may use, against torch's threads."""
    allowed = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    quota = _cgroup("cpu.max", lambda said: int(said.split()[0]) / int(said.split()[1]))
    usable = allowed if quota is None else min(allowed, max(1, round(quota)))
    threads = _threads()
    if threads is not None and threads > usable:
        raise Off(f"{threads} threads on {usable} cores", f"OMP_NUM_THREADS={usable} clod-adapt ...")
    return f"{usable} of {os.cpu_count()}"


def _threads() -> int | None:
    torch = sys.modules.get("torch")  # what is wrong with it is another line
    return torch.get_num_threads() if torch is not None else None


def memory() -> str:
    """What is free, within a container's limit."""
    total, free = _memory()
    limit = _cgroup("memory.max", int)
    used = _cgroup("memory.current", int)
    if limit is not None and used is not None and limit < total:
        total, free = limit, min(free, limit - used)
    return f"{free / 2**30:.1f} GB free of {total / 2**30:.1f} GB"


def _memory() -> tuple[float, float]:
    """Bytes of all memory, and of what is free or can be freed."""
    if MEMINFO.is_file():
        rows = dict(line.split(":") for line in MEMINFO.read_text().splitlines())
        return int(rows["MemTotal"].split()[0]) * 1024, int(rows["MemAvailable"].split()[0]) * 1024
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        raise Off("this system does not say", "look at the task manager")
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return total, total


def _cgroup(name: str, read: Callable[[str], float]) -> float | None:
    """A limit of the container that this runs in; None where there is none."""
    with contextlib.suppress(OSError, ValueError):  # absent, or "max"
        return read((CGROUP / name).read_text())
    return None


def cache() -> str:
    """Where undistorted photographs and compiled kernels are kept; a file is written in the first."""
    try:
        folder = user_caches() / "clod-adapter"
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder) as file:
            file.write(bytes(1024))
    except (OSError, ClodError) as error:
        reason = f"{folder}: {error.strerror}" if isinstance(error, OSError) else str(error)
        raise Off(f"cannot be written ({reason})", "set XDG_CACHE_HOME to a folder that can be") from error
    from clod_adapter._kernels import blend

    kept = getattr(blend.blend._cache, "cache_path", None)
    if kept is None:
        raise Off("compiled kernels cannot be kept", "set NUMBA_CACHE_DIR to a folder that can be written")
    return f"{folder}; kernels in {kept}"


def _gaussians() -> Gaussians:
    from clod_adapter.gaussians import Gaussians

    given = Miniature.make().arguments
    return Gaussians(
        means=given["means"], quats=given["quats"], log_scales=given["scales"].log(), sh0=given["sh0"],
        shN=given["shN"], opacity_logits=given["opacities"].logit(),
    )  # fmt: skip


TOOLS: dict[str, Look] = {
    "plots": plots, "glb": glb, "splat-transform": splat_transform, "demo": demo, "lpips": metric("lpips"),
    "flip": metric("flip"), "browser": browser, "cores": cores, "memory": memory, "cache": cache,
}  # fmt: skip
