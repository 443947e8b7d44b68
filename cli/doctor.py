"""``clod-adapt doctor``: what renders and shows on this machine, and how to fix what does not."""

import io
import warnings
from argparse import Namespace
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from typing import Any

from clod_adapter._support.text import first_line

from .shared.console import Console
from .shared.outputs import Report
from .view import find_browser

TORCH = "pip install --force-reinstall torch (https://pytorch.org has the command for a GPU)"
REINSTALL = (
    "pip install --force-reinstall numba; if that does not help, report it with clod-adapt doctor"
    " --json"
)
NO_BROWSER = (
    "clod-adapt view --no-browser --port 8000, and ssh -L 8000:127.0.0.1:8000 HOST where there is a"
    " browser"
)
# RMS of colours in [0, 1]: rounding, and a pixel or two on the other side of a threshold
TOLERANCE = 2e-4
RENDERERS = ("cpu", "gsplat")


Found = tuple[bool, str, str]  # whether it works, the result, and a command to type or what to do


def check_torch() -> Found:
    try:
        import torch
    except Exception as error:  # OSError too, where a library that it links to is missing
        return False, f"cannot be imported ({first_line(error)})", TORCH
    built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "a CPU build"
    return True, f"{torch.__version__}, {built}, {torch.get_num_threads()} threads", ""


def check_gsplat() -> Found:
    """gsplat on the GPU; may compile its kernels for minutes, once."""
    import torch

    from .shared.inputs import no_gpu

    if reason := no_gpu():
        found, _, fix = reason.partition(": ")
        return (
            False,
            found,
            fix or "install NVIDIA's driver, and a torch for its CUDA from https://pytorch.org",
        )
    return rendered(
        "cuda", f"{torch.cuda.get_device_name()}; ", "pip install --force-reinstall gsplat==1.5.3"
    )


def check_browser() -> Found:
    """Finds a browser without opening it."""
    found = find_browser()
    if found is None:
        return False, "none found that opens a window", NO_BROWSER
    return True, str(getattr(found, "name", "") or type(found).__name__), ""


CHECKS: dict[str, Callable[[], Found]] = {
    "torch": check_torch,
    "cpu": lambda: rendered("cpu", "", REINSTALL),
    "gsplat": check_gsplat,
    "browser": check_browser,
}


def rendered(device: str, name: str, fix: str) -> Found:
    """Renders sixty Gaussians and compares the image with the reference rasterizer's."""
    import torch

    from clod_adapter import Camera
    from clod_adapter.cameras import intrinsics
    from clod_adapter.rasterizers import for_device, reference

    normal = partial(torch.randn, generator=torch.Generator().manual_seed(7))
    scene: dict[str, Any] = {
        "means": normal(60, 3).clamp(-1.5, 1.5) + torch.tensor([0.0, 0.0, 4.0]),
        "quats": normal(60, 4),
        "scales": (0.5 * normal(60, 3) - 2).exp(),
        "opacities": (1.5 * normal(60)).sigmoid().clamp(max=0.95),
        "sh0": normal(60, 1, 3),
        "shN": 0.1 * normal(60, 3, 3),
        "background": torch.zeros(3),
    }
    camera = Camera(torch.eye(4), intrinsics(60.0, 60, 32, 24), 64, 48)
    want, _ = reference.rasterize(**scene, camera=camera)
    splat = for_device(torch.device(device)).splat
    image, _ = splat(**{name: value.to(device) for name, value in scene.items()}, camera=camera)
    error = float((image.detach().cpu() - want).square().mean().sqrt())
    if not error <= TOLERANCE:  # or no number
        return False, f"renders another image than the reference (RMS {error:.2g})", fix
    return True, f"{name}renders the reference image (RMS {error:.0e})", ""


def execute(args: Namespace) -> Report:
    """Runs all checks; the report's exit code is 1 where nothing renders."""
    findings = list[Report]()
    with Console(args.quiet).status("checking ..."), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's
        for name, check in CHECKS.items():
            try:
                with redirect_stdout(io.StringIO()):  # gsplat prints
                    ok, found, fix = check()
            except Exception as error:  # any is a result: the code belongs to other projects
                # a Ctrl-C within the dispatching of a compiled function
                if isinstance(error.__cause__, KeyboardInterrupt):
                    raise
                ok, found, fix = False, f"{type(error).__name__}: {first_line(error)}", ""
            findings.append({"name": name, "ok": ok, "found": found, "fix": fix})
    draws = [each["name"] for each in findings if each["ok"] and each["name"] in RENDERERS]
    for each in findings:
        print(f"{each['name']:<9}{'ok' if each['ok'] else 'off':<5}{each['found']}")
        if each["fix"]:
            print(f"    -> {each['fix']}")
    failed = "no rendering backend works: fix torch first, then the CPU backend"
    print(f"rendering and training backends: {', '.join(draws)}" if draws else failed)
    return {"draws": draws, "exit_code": 0 if draws else 1, "findings": findings}


DESCRIPTION = "Check what renders here, and say how to fix the rest."
USAGE = "[--json] [--quiet]"
EPILOG = """\
Each line has a name, ok or off, the result, and after -> the fix. Of cpu and
gsplat, ok means that the image of a test scene is the reference's. Nothing is
installed or downloaded. The first run compiles the CPU's kernels, and on a GPU
gsplat's, which can take minutes.

exit codes: 0 cpu or gsplat works; 1 neither does
"""
