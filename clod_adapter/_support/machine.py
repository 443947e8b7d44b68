"""The machine that numbers were measured on."""

import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
import torch


def machine() -> dict[str, Any]:
    """Processor, cores, threads, versions and, if there is one, GPU, for reports."""
    gpu = {"gpu": torch.cuda.get_device_name()} if torch.cuda.is_available() else {}
    versions = {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
    }
    return (
        gpu
        | {"cpu": _cpu_name(), "cores": os.cpu_count(), "threads": torch.get_num_threads()}
        | versions
    )


def machine_name(device: str = "cpu") -> str:
    """The hardware that determines frame times on that type of device."""
    about = machine()
    return about["gpu"] if device == "cuda" else f"{about['cpu']}, {about['threads']} threads"


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
