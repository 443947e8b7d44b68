"""Checks of the NVIDIA GPU backends, from the driver up."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from clod_adapter._support.text import first_line
from clod_adapter.errors import ClodError

from .checks import CheckFailed, Probe
from .reference_scene import INRIA_TOLERANCE, ReferenceScene

TORCH = "pip install --force-reinstall torch"
TORCH_CUDA = f"{TORCH} --index-url https://download.pytorch.org/whl/cu128"
GPU = "pip install gsplat==1.5.3 setuptools"
DRIVER = "install NVIDIA's driver: https://www.nvidia.com/drivers (a container needs --gpus all)"
COMPILE = 'python -c "from gsplat.cuda._backend import _C"'
GSPLAT = (1, 4, 0)  # the oldest supported version
TIMEOUT = 10.0  # seconds, of nvidia-smi or a collective
PCI = Path("/sys/bus/pci/devices")
NVIDIA = "0x10de"


def build_of_torch() -> str:
    import torch

    if torch.version.cuda:
        return f"built for CUDA {torch.version.cuda}"
    return f"built for ROCm {torch.version.hip}" if torch.version.hip else "a CPU build"


def driver() -> str:
    """GPUs that nvidia-smi lists."""
    question = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        done = subprocess.run(
            question, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=TIMEOUT
        )
    except FileNotFoundError as error:
        if PCI.is_dir() and not _on_the_bus():
            raise CheckFailed("no NVIDIA GPU on the PCI bus", "use a machine with an NVIDIA GPU") from error
        raise CheckFailed("no nvidia-smi", DRIVER) from error
    except subprocess.TimeoutExpired as error:
        raise CheckFailed(f"nvidia-smi does not answer within {TIMEOUT:.0f} s", "restart the machine") from error
    said = [line.strip() for line in done.stdout.splitlines() if line.strip()]
    if done.returncode or not said:
        reason = (said or done.stderr.strip().splitlines() or ["no GPU listed"])[0]
        raise CheckFailed(f"nvidia-smi failed: {reason}", DRIVER)
    return "; ".join(said)


def _on_the_bus() -> bool:
    vendors = (device / "vendor" for device in (PCI.iterdir() if PCI.is_dir() else ()))
    return any(vendor.is_file() and vendor.read_text().strip() == NVIDIA for vendor in vendors)


def cuda() -> str:
    """torch computes on the GPU; its name, memory and compute capability."""
    import torch

    device = cuda_device()
    about = torch.cuda.get_device_properties(device)
    more = f" and {torch.cuda.device_count() - 1} more" if torch.cuda.device_count() > 1 else ""
    return (
        f"{about.name}, {about.total_memory / 2**30:.0f} GB, compute capability {about.major}.{about.minor}{more}; "
        f"torch {build_of_torch()}"
    )


def cuda_device() -> Any:
    """The GPU, on which torch has just computed.

    Raises:
        CheckFailed: torch cannot compute on it.
    """
    import torch

    if torch.version.cuda is None:
        first = "" if shutil.which("nvidia-smi") else "fix driver first, then "
        raise CheckFailed(f"torch {torch.__version__} is {build_of_torch()}", first + TORCH_CUDA)
    try:
        device = torch.device("cuda")
        right = int(torch.arange(8, device=device).square().sum()) == 140
    except (RuntimeError, AssertionError) as error:
        old = "kernel image" in str(error) or "too old" in str(error)
        fix = f"update NVIDIA's driver, or install a matching torch: {TORCH_CUDA}" if old else "fix driver first"
        raise CheckFailed(f"torch {torch.__version__} cannot use the GPU: {first_line(error)}", fix) from error
    if not right:
        raise CheckFailed(f"torch {torch.__version__} computes a wrong sum on the GPU", TORCH_CUDA)
    return device


def _device_for(installed: str) -> Any:
    """The GPU, for an installed package, which the error names where there is no GPU."""
    try:
        return cuda_device()
    except CheckFailed as failed:
        raise CheckFailed(f"{installed}, but {failed.found}", failed.fix) from failed


def gsplat() -> str:
    """gsplat's own ``rasterization``, through the integration."""
    version = _gsplat_version()
    device = _device_for(version)
    _gsplat_is_compiled(version)
    import torch

    from clod_adapter.integrations.gsplat import rasterization

    scene = ReferenceScene.make()
    given: dict[str, Any] = dict(scene.on(device))
    colors = torch.cat([given.pop("sh0"), given.pop("shN")], 1)
    views = [scene.camera.viewmat.to(device)[None], scene.camera.K.to(device)[None]]
    image, _, _ = rasterization(
        **given, colors=colors, viewmats=views[0], Ks=views[1], width=scene.camera.width, height=scene.camera.height,
        sh_degree=1,
    )  # fmt: skip
    return f"{version}; {scene.compare(image[0])}"


def _gsplat_version() -> str:
    if find_spec("gsplat") is None:
        raise CheckFailed("not installed", GPU)
    import gsplat

    numbers = tuple(int(each) for each in gsplat.__version__.split("+")[0].split(".")[:3] if each.isdigit())
    if numbers < GSPLAT:
        raise CheckFailed(f"{gsplat.__version__}, {'.'.join(map(str, GSPLAT))} is needed", GPU)
    return str(gsplat.__version__)


def _gsplat_is_compiled(version: str) -> None:
    """Raises CheckFailed where importing gsplat's kernels would compile them for minutes, or fail."""
    from torch.utils.cpp_extension import CUDA_HOME, _get_build_directory

    built = Path(_get_build_directory("gsplat_cuda", verbose=False))  # where gsplat looks
    if find_spec("gsplat.csrc") is None and not any((built / f"gsplat_cuda.{end}").is_file() for end in ("so", "lib")):
        if CUDA_HOME is None:
            import torch

            toolkit = f"the CUDA toolkit {torch.version.cuda}: https://developer.nvidia.com/cuda-toolkit-archive"
            raise CheckFailed(f"{version}, not compiled, and no nvcc found", f"install {toolkit}; then {COMPILE}")
        raise CheckFailed(f"{version}, not compiled yet; nvcc is in {CUDA_HOME}", f"{COMPILE}  (minutes, once)")


def gpu() -> str:
    """The rasterizer of ``--device cuda``."""
    from clod_adapter.rasterizers import for_device

    device = cuda_device()
    try:
        rasterize = for_device(device)
        return ReferenceScene.make().check(rasterize, device)
    except (ClodError, ImportError) as error:
        raise CheckFailed(first_line(error), f"fix gsplat first, or {GPU}") from error


def inria() -> str:
    """The installed fork of diff-gaussian-rasterization, through the integration."""
    try:
        import clod_adapter.integrations.inria as fork
    except ImportError as error:
        install = str(error).rpartition("CUDA: ")[2]
        raise CheckFailed(first_line(error.__cause__ or error), install) from error
    import diff_gaussian_rasterization as installed
    import torch

    where = str(Path(str(installed.__file__)).parent)
    scene, device = ReferenceScene.make(), _device_for(where)
    given = scene.on(device)
    drawn = fork.GaussianRasterizer(_inria_settings(fork.GaussianRasterizationSettings, scene, device))(
        means3D=given["means"], means2D=torch.zeros_like(given["means"]), opacities=given["opacities"][:, None],
        shs=torch.cat([given["sh0"], given["shN"]], 1), scales=given["scales"],
        rotations=torch.nn.functional.normalize(given["quats"]),
    )  # fmt: skip
    return f"{where}; {scene.compare(drawn[0].permute(1, 2, 0), INRIA_TOLERANCE)}"


def _inria_settings(kind: Callable[..., Any], scene: ReferenceScene, device: Any) -> Any:
    """The scene's camera in the fork's settings; settings that only other forks have are switched off."""
    import torch

    view, near, far = scene.camera, 0.01, 100.0
    tan_x, tan_y = view.width / (2 * float(view.K[0, 0])), view.height / (2 * float(view.K[1, 1]))
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1 / tan_x, 1 / tan_y, 1.0
    projection[2, 2], projection[2, 3] = far / (far - near), -far * near / (far - near)
    known = {
        "image_height": view.height, "image_width": view.width, "tanfovx": tan_x, "tanfovy": tan_y,
        "bg": torch.zeros(3, device=device), "scale_modifier": 1.0, "viewmatrix": view.viewmat.T.to(device),
        "projmatrix": (projection @ view.viewmat).T.to(device), "sh_degree": 1,
        "campos": view.position.to(device), "prefiltered": False, "debug": False,
    }  # fmt: skip
    return kind(**{name: known.get(name, False) for name in getattr(kind, "_fields", known)})


GPU_PROBES: dict[str, Probe] = {"driver": driver, "cuda": cuda, "gsplat": gsplat, "gpu": gpu, "inria": inria}
