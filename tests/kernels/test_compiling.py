"""Compiled kernels: cached where that is possible, and working where it is not."""

from __future__ import annotations

import os
import subprocess
import sys

CODE = """
import torch
from clod_adapter._kernels import tiles
from clod_adapter.losses import ssim
print(type(tiles.radix_sort._cache).__name__, round(ssim(torch.ones(4, 4, 3), torch.full((4, 4, 3), 255).byte()), 3))
"""


def run(**environment: str) -> str:
    command = [sys.executable, "-c", CODE]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_folder_that_cannot_be_written_only_costs_the_cache() -> None:
    nowhere = os.path.join(os.devnull, "cache")
    locators = {"NUMBA_CACHE_DIR": nowhere, "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    assert run(**locators) == "NullCache 1.0"


def test_kernels_are_cached() -> None:
    assert run() == "FunctionCache 1.0"
