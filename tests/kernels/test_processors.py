"""Kernels compiled for another processor agree with the reference.

NAME has vectors of 4 lanes and no fused multiply-add. All other tests use this processor, whose vectors are usually
wider and which has fused multiply-add.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import llvmlite.binding as llvm
import pytest

CODE = """
import clod_adapter
import torch
from clod_adapter.rasterizers import cpu
from oracle import assert_agrees
from scenes import camera, scene

for degree in (1, 3):
    assert_agrees(cpu.rasterize, scene(200, degree, degree, size=0.2), camera())
for length in (1e-8, 1e2, 1e3, 1e4):
    for axes in (1, 3):
        some = scene(100, 1, 5)
        some["scales"][::30, :axes] = length
        assert_agrees(cpu.rasterize, some, camera(), image=1e-4)
for seed in range(2):
    for scales in ((1.0, 1e-6, 1e-6), (0.3, 0.3, 3e-7)):
        some = scene(80, 1, seed)
        some["scales"] = torch.tensor(scales).repeat(80, 1)
        assert_agrees(cpu.rasterize, some, camera(), image=3e-4)
print("agrees")
"""
NAME, NEEDS = "nehalem", "sse4.2"  # LLVM's name, and the feature that runs its code


@pytest.mark.skipif(not os.environ.get("CLOD_COMPILE"), reason="compiles all kernels anew; set CLOD_COMPILE=1")
@pytest.mark.timeout(600)
def test_kernels_for_another_processor_agree_with_the_reference() -> None:
    if not llvm.get_host_cpu_features().get(NEEDS, False):
        pytest.skip(f"needs {NEEDS}")
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"NUMBA_CPU_NAME": NAME, "NUMBA_CPU_FEATURES": "", "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "agrees", done.stderr
