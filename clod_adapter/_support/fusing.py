"""Elementwise formulas as one pass over their tensors on a GPU: ``torch.compile`` of the plain one, never a second one.

Plain torch reads and writes each intermediate. One compiled pass reads the inputs and writes the results, forward and
backward; only many rows repay the tens of seconds that the first call on a machine takes to compile.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

ROWS = 1 << 19
"""From so many rows on. Below, plain torch's passes are launches of a few microseconds, and compiling takes longer than
what they cost in a whole training."""

Number = float | Tensor
"""What is a float where the function runs as it is written, and a 0-d tensor where it runs compiled."""


class Fused:
    """A function of tensors and floats that on a GPU runs compiled, and anywhere else as it is written.

    Compiled, a float becomes a 0-d float64 tensor (or torch would compile anew for each value); what is named is fixed
    at compilation. Where torch cannot compile, the plain function runs, and a warning says so once. What is compiled
    can be gone back through once: for retain_graph=True, TORCH_COMPILE_DISABLE=1 has the plain function run.

    Args:
        function: differentiable by autograd, of elementwise operations; its first argument a tensor with a row each.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.plain = function
        self._compiled: Callable[..., Any] | None = None
        self._failed = False

    def __call__(self, *values: Tensor | float, **fixed: Any) -> Any:
        return self.compiled(*values, **fixed) if self.compiles(values[0]) else self.plain(*values, **fixed)

    def compiles(self, first: Any) -> bool:
        """Whether a call with this first argument is to run compiled."""
        return bool(first.is_cuda) and len(first) >= ROWS and not self._failed

    def compiled(self, *values: Tensor | float, **fixed: Any) -> Any:
        """Compiled wherever the tensors are."""
        if self._compiled is None:
            self._compiled = torch.compile(self.plain, fullgraph=True, dynamic=True)
        try:
            return self._compiled(*_tensors(values), **fixed)
        except torch.cuda.OutOfMemoryError:  # torch's own name for it came after 2.4
            raise
        except Exception as error:  # of a missing compiler, of triton, of dynamo: they share no class
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
