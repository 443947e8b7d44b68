"""What draws and trains: Python, torch, the rasterizers, and several processes. Each look does the thing itself."""

from __future__ import annotations

import platform
from datetime import timedelta
from typing import Any

from ..shared.findings import Look, Miniature, Off, first_line
from .gpu import ASKING, GPU_LOOKS, TORCH, TORCH_CUDA, build_of_torch, cuda_device


def python() -> str:
    return f"{platform.python_version()} on {platform.system()} {platform.machine()}"


def torch_() -> str:
    """Works, which of its builds it is, and on how many threads."""
    try:
        import torch
    except Exception as error:  # OSError too, where a library that it links to is missing
        raise Off(f"cannot be imported ({first_line(error)})", TORCH) from error
    if int(torch.arange(8).square().sum()) != 140:
        raise Off(f"{torch.__version__} sums wrongly", TORCH)
    return f"{torch.__version__}, {build_of_torch()}, {torch.get_num_threads()} threads"


def cpu() -> str:
    """The compiled rasterizer's picture, and how wide the registers are that its vectors were compiled for."""
    import torch
    from numba.core.registry import cpu_target

    from clod_adapter.rasterizers import for_device

    from ..shared.kernels import one_thread

    mini, device = Miniature.make(), torch.device("cpu")
    with one_thread():  # compiles, where that has not been done yet
        mini.drawn_by(for_device(device), device)
    picture = mini.drawn_by(for_device(device), device)
    features = cpu_target.target_context.codegen().magic_tuple()[2].split(",")  # NUMBA_CPU_FEATURES in them
    width = 512 if "+avx512f" in features else 256 if "+avx" in features else 128
    return f"compiled for {width}-bit vectors; {picture}"


def processes() -> str:
    """torch.distributed: a sum over a group of one process, over gloo, and over NCCL where there is a GPU."""
    import torch

    if not torch.distributed.is_available() or not torch.distributed.is_gloo_available():
        raise Off(f"torch {torch.__version__} is built without torch.distributed or gloo", TORCH)
    _sum_over(torch.distributed.ProcessGroupGloo, "cpu")
    try:
        device = cuda_device()
    except Off as off:
        return f"gloo; nccl is for GPUs: {off.found}"
    if not torch.distributed.is_nccl_available():
        raise Off("gloo, but no nccl in this torch", TORCH_CUDA)
    _sum_over(torch.distributed.ProcessGroupNCCL, device)
    return "gloo and nccl"


def _sum_over(group: Any, device: Any) -> None:
    """One all-reduce in a group of its own, so that a group of the caller's stays as it is."""
    import torch
    from torch._C._distributed_c10d import HashStore  # torch.distributed has it and does not say so

    store, numbers = HashStore(), torch.arange(4.0, device=device)
    try:
        alone = group(store, 0, 1, timedelta(seconds=ASKING))
        alone.allreduce([numbers]).wait()
        if numbers.tolist() != [0, 1, 2, 3]:
            raise RuntimeError(f"the sum of one process is {numbers.tolist()}")
    except RuntimeError as error:
        fix = "give the interface to use: GLOO_SOCKET_IFNAME=lo (or NCCL_SOCKET_IFNAME)"
        raise Off(f"a sum over one process fails: {first_line(error)}", fix) from error


BACKENDS: dict[str, Look] = {"python": python, "torch": torch_, "cpu": cpu} | GPU_LOOKS | {"processes": processes}
