"""Which device a command works on: the GPU where it can draw there, else the CPU, with the reason in a line."""

from __future__ import annotations

from dataclasses import replace

import torch

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.rasterizers.cuda import unusable

from .console import Console
from .findings import first_line


def pick_device(name: str, console: Console) -> torch.device:
    """The device of ``--device``; says in a line why a GPU that is there is not used.

    Raises:
        ClodError: cuda was asked for and cannot be had; says what to install.
    """
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    reason = no_gpu()
    if reason is None:
        device = torch.device("cuda", torch.cuda.current_device())
        console.say(f"on {torch.cuda.get_device_name(device)}")
        return device
    if name == "cuda":
        raise ClodError(f"--device cuda: {reason}; or use --device cpu")
    console.say(f"on the CPU, although there is a GPU: {reason}")
    return torch.device("cpu")


def no_gpu() -> str | None:
    """Why nothing can be drawn on a GPU here, None where it can. The first time gsplat may compile for minutes."""
    if torch.cuda.is_available():
        return _fails() or unusable()
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA: install torch from https://pytorch.org for your CUDA"
    return "torch sees no NVIDIA GPU: nvidia-smi says whether there is one, and whether its driver is as new as CUDA's"


def _fails() -> str | None:
    """Why torch cannot compute on the GPU that it sees: one too old or too new for this torch, or taken."""
    try:
        torch.ones(1, device="cuda").add_(1).item()
    except (RuntimeError, AssertionError) as error:
        return f"torch cannot compute on it ({first_line(error)}); clod-adapt doctor says what mends that"
    return None


def on_device(checkpoint: Checkpoint, device: torch.device) -> Checkpoint:
    """The checkpoint with its Gaussians there. Photographs stay where they were read, and go over one at a time."""
    return replace(checkpoint, gaussians=checkpoint.gaussians.to(device))
