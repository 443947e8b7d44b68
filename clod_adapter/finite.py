"""Which rows hold a value that is not finite, and what is refused for it before work is spent."""

from __future__ import annotations

import torch
from torch import Tensor

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians


class LossNotFinite(Exception):
    """A step's loss is not finite, so nothing can be learned from it."""


def bad_rows(values: Tensor) -> Tensor | None:
    """``[N]`` bool, the rows of ``values [N, ...]`` that hold a value that is not finite; None where there is none.

    One pass, without memory of its own, where all are: a sum with a term that is not finite is not finite either.
    """
    if bool(values.sum().isfinite()):
        return None
    bad = ~values.isfinite().reshape(len(values), -1).all(1)
    return bad if bool(bad.any()) else None


def spoilt_rows(gradients: dict[str, Tensor]) -> Tensor:
    """``[N]`` bool, the rows that are bad in any of the gradients ``[N, ...]``."""
    tensors = list(gradients.values())
    spoilt = torch.zeros(len(tensors[0]), dtype=torch.bool, device=tensors[0].device)
    if bool(torch.stack([tensor.sum() for tensor in tensors]).isfinite().all()):  # a GPU is asked once
        return spoilt
    for tensor in tensors:
        if (bad := bad_rows(tensor)) is not None:
            spoilt |= bad
    return spoilt


def bad_gaussians(gaussians: Gaussians) -> dict[str, Tensor]:
    """By attribute, its ``bad_rows``, of those that have any. An opacity logit may be +-inf: an opacity of 1 or 0."""
    found = {}
    for name, values in gaussians.tensors().items():
        if name == "opacity_logits":
            values = torch.where(values.isinf(), 0.0, values)
        if (bad := bad_rows(values)) is not None:
            found[name] = bad
    return found


def require_finite(gaussians: Gaussians, what: str, remedy: str) -> None:
    """Refuses Gaussians with an attribute that is not finite.

    Args:
        what, remedy: the subject of the message, and its end.

    Raises:
        ClodError: some row of some attribute is not finite; an opacity logit of +-inf is allowed.
    """
    for name, bad in bad_gaussians(gaussians).items():
        first = int(bad.nonzero()[0, 0])
        raise ClodError(f"{what}: {name} is not finite in {int(bad.sum()):,} rows (the first is {first}); {remedy}")


def largest_colour(gaussians: Gaussians) -> str:
    """Where colours are largest, for messages: what overflows in a picture is one of these."""
    colours = {name: getattr(gaussians, name).abs().flatten(1) for name in ("sh0", "shN")}
    rows = {name: values.amax(1) for name, values in colours.items() if values.numel()}
    name = max(rows, key=lambda each: float(rows[each].max()))
    value, row = rows[name].max(0)
    return f"the largest {name} is {float(value):.3g}, in row {int(row)}: leave out such rows"
