"""Elementwise functions fused into one pass on a GPU by ``torch.compile``; there is no second implementation.

Plain torch reads and writes each intermediate; a compiled pass reads the inputs and writes the results, forward and
backward. Compiling takes tens of seconds on the first call, which pays off for many rows only.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

ROWS = 1 << 19
"""Fewest rows for compiling. Below, all of plain torch's passes in a training take less time than compiling."""

Number = float | Tensor
"""A float in a plain call, a 0-d tensor in a compiled one."""


class Fused:
    """A function of tensors and floats that runs compiled on a GPU and plain elsewhere.

    In compiled calls a float becomes a 0-d float64 tensor, so that torch does not compile for each value; keyword
    arguments other than tensors are constants of the compilation. If compiling fails, the plain function runs and one
    warning is given.
    Compiled graphs allow one backward pass: for retain_graph=True, set TORCH_COMPILE_DISABLE=1.

    Args:
        function: differentiable by autograd, elementwise; its first argument is a tensor with one row per Gaussian.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.plain = function
        self._compiled: Callable[..., Any] | None = None
        self._failed = False

    def __call__(self, *values: Tensor | float, **fixed: Any) -> Any:
        return self.compiled(*values, **fixed) if self.compiles(values[0]) else self.plain(*values, **fixed)

    def compiles(self, first: Any) -> bool:
        """Whether a call with this first argument runs compiled."""
        return bool(first.is_cuda) and len(first) >= ROWS and not self._failed

    def compiled(self, *values: Tensor | float, **fixed: Any) -> Any:
        """A compiled call on any device."""
        if self._compiled is None:
            self._compiled = torch.compile(self.plain, fullgraph=True, dynamic=True)
        try:
            return self._compiled(*_tensors(values), **fixed)
        except torch.cuda.OutOfMemoryError:  # torch.OutOfMemoryError came after torch 2.4
            raise
        except Exception as error:  # a missing compiler, triton or dynamo: no common class
            self._failed = True
            reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
            warnings.warn(
                f"torch.compile fails here ({reason.strip()}), so the dial runs as plain torch on the GPU: the same "
                "results, with several times as many passes over the Gaussians",
                stacklevel=3,
            )
            return self.plain(*values, **fixed)


def _tensors(values: tuple[Tensor | float, ...]) -> list[Tensor]:
    """The values with floats as 0-d tensors, moved in one transfer."""
    floats = [value for value in values if not isinstance(value, Tensor)]
    device = next(value.device for value in values if isinstance(value, Tensor))
    moved = iter(torch.tensor(floats, dtype=torch.float64).to(device, non_blocking=True))
    return [value if isinstance(value, Tensor) else next(moved) for value in values]
