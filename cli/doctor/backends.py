"""Checks of the backends: Python, torch, the rasterizers, and several processes."""

from __future__ import annotations

import platform
from datetime import timedelta
from typing import Any

from clod_adapter._support.text import first_line

from .checks import CheckFailed, Probe
from .gpu import GPU_PROBES, TIMEOUT, TORCH, TORCH_CUDA, build_of_torch, cuda_device
from .reference_scene import ReferenceScene


def python() -> str:
    return f"{platform.python_version()} on {platform.system()} {platform.machine()}"


def torch_() -> str:
    """Version, build and number of threads; checks a sum."""
    try:
        import torch
    except Exception as error:  # OSError too, where a library that it links to is missing
        raise CheckFailed(f"cannot be imported ({first_line(error)})", TORCH) from error
    if int(torch.arange(8).square().sum()) != 140:
        raise CheckFailed(f"{torch.__version__} computes a wrong sum", TORCH)
    return f"{torch.__version__}, {build_of_torch()}, {torch.get_num_threads()} threads"


def cpu() -> str:
    """The compiled rasterizer renders the reference image; the width of its vector registers."""
    import torch
    from numba.core.registry import cpu_target

    from clod_adapter.rasterizers import for_device

    from ..shared.kernels import one_thread

    scene, device = ReferenceScene.make(), torch.device("cpu")
    with one_thread():  # compiles on the first run
        scene.check(for_device(device), device)
    result = scene.check(for_device(device), device)
    features = cpu_target.target_context.codegen().magic_tuple()[2].split(",")  # NUMBA_CPU_FEATURES in them
    width = 512 if "+avx512f" in features else 256 if "+avx" in features else 128
    return f"compiled for {width}-bit vectors; {result}"


def processes() -> str:
    """torch.distributed: a sum over a group of one process, over gloo, and over NCCL where there is a GPU."""
    import torch

    if not torch.distributed.is_available() or not torch.distributed.is_gloo_available():
        raise CheckFailed(f"torch {torch.__version__} is built without torch.distributed or gloo", TORCH)
    _sum_over(torch.distributed.ProcessGroupGloo, "cpu")
    try:
        device = cuda_device()
    except CheckFailed as failed:
        return f"gloo; no nccl: {failed.found}"
    if not torch.distributed.is_nccl_available():
        raise CheckFailed("gloo works, but this torch has no nccl", TORCH_CUDA)
    _sum_over(torch.distributed.ProcessGroupNCCL, device)
    return "gloo and nccl"


def _sum_over(group: Any, device: Any) -> None:
    """One all-reduce in a new group, so that the caller's group is not touched."""
    import torch
    from torch._C._distributed_c10d import HashStore  # not exported by torch.distributed

    store, numbers = HashStore(), torch.arange(4.0, device=device)
    try:
        alone = group(store, 0, 1, timedelta(seconds=TIMEOUT))
        alone.allreduce([numbers]).wait()
        if numbers.tolist() != [0, 1, 2, 3]:
            raise RuntimeError(f"the sum of one process is {numbers.tolist()}")
    except RuntimeError as error:
        fix = "set the network interface: GLOO_SOCKET_IFNAME=lo (or NCCL_SOCKET_IFNAME)"
        raise CheckFailed(f"the sum over one process failed: {first_line(error)}", fix) from error


BACKENDS: dict[str, Probe] = {"python": python, "torch": torch_, "cpu": cpu} | GPU_PROBES | {"processes": processes}
