"""The device of a command: the GPU where a backend works on it, else the CPU, with the reason in a line."""

from __future__ import annotations

from dataclasses import replace

import torch

from clod_adapter._support.text import first_line
from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import Checkpoint
from clod_adapter.rasterizers.cuda import unusable

from .console import Console


def pick_device(name: str, console: Console) -> torch.device:
    """The device of ``--device``; prints why a GPU is not used.

    Raises:
        ClodError: cuda was asked for and does not work; the message says what to install.
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
    """Why no GPU backend works, None if one does. The first call may compile gsplat for minutes."""
    if torch.cuda.is_available():
        return _fails() or unusable()
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA: install torch from https://pytorch.org for your CUDA"
    return "torch finds no NVIDIA GPU; check with nvidia-smi that there is one and that its driver is new enough"


def _fails() -> str | None:
    """Why torch cannot compute on the GPU that it finds: not supported by this torch, or in use."""
    try:
        torch.ones(1, device="cuda").add_(1).item()
    except (RuntimeError, AssertionError) as error:
        return f"torch cannot compute on it ({first_line(error)}); clod-adapt doctor prints a fix"
    return None


def on_device(checkpoint: Checkpoint, device: torch.device) -> Checkpoint:
    """The checkpoint with its Gaussians on the device. Photographs stay in main memory and are copied one at a time."""
    return replace(checkpoint, gaussians=checkpoint.gaussians.to(device))
