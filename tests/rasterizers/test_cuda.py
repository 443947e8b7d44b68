"""Why gsplat cannot be used, in one line."""

from __future__ import annotations

import builtins
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from clod_adapter.rasterizers import cuda


@pytest.mark.parametrize("missing", ["the package", "its kernels", "a library", "a version"])
def test_unusable_says_what_gsplat_lacks(monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    cuda.unusable.cache_clear()
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = None if missing == "its kernels" else SimpleNamespace()
    package = ModuleType("gsplat.cuda")
    package._backend = backend
    top = ModuleType("gsplat")
    top.__version__ = "1.3.0" if missing == "a version" else "1.5.3+pt24cu124"
    for name, module in (("gsplat", top), ("gsplat.cuda", package), ("gsplat.cuda._backend", backend)):
        monkeypatch.setitem(sys.modules, name, None if missing == "the package" else module)
    real = builtins.__import__

    def importing(name: str, *args: Any, **kwargs: Any) -> Any:
        if missing == "a library" and name == "gsplat":
            raise OSError("libcudart.so.12: cannot open shared object file")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", importing)
    try:
        reason = cuda.unusable()
    finally:
        cuda.unusable.cache_clear()
    assert reason is not None and "\n" not in reason
    assert ("pip install gsplat==1.5.3" in reason) != (missing == "its kernels")
    expected = {
        "the package": "gsplat", "its kernels": "install nvcc", "a library": "libcudart.so.12",
        "a version": "gsplat 1.3.0 is too old",
    }  # fmt: skip
    assert expected[missing] in reason
