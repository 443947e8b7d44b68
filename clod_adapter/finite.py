"""Rows with values that are not finite: finding them, and refusing them before training."""

import torch
from torch import Tensor

from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians


class LossNotFinite(Exception):
    """The loss of a training step is not finite."""


def bad_rows(values: Tensor) -> Tensor | None:
    """``[N]`` bool, the rows of ``values [N, ...]`` with a value that is not finite; None if there is none."""
    if bool(values.sum().isfinite()):  # one pass without extra memory
        return None
    bad = spoilt_rows({"": values})
    return bad if bool(bad.any()) else None


def spoilt_rows(gradients: dict[str, Tensor]) -> Tensor:
    """``[N]`` bool, the rows that are bad in any of the gradients ``[N, ...]``."""
    tensors = list(gradients.values())
    if tensors[0].device.type == "cpu" and all(bool(tensor.sum().isfinite()) for tensor in tensors):
        return torch.zeros(len(tensors[0]), dtype=torch.bool)  # a GPU is not asked: the host would wait for its answer
    return torch.stack([~tensor.isfinite().reshape(len(tensor), -1).all(1) for tensor in tensors]).any(0)


def require_finite(gaussians: Gaussians, what: str, remedy: str) -> None:
    """Raises ClodError, ``what`` being its subject and ``remedy`` its end, where an attribute is not finite."""
    for name, values in gaussians.tensors().items():
        if name == "opacity_logits":
            values = torch.where(values.isinf(), 0.0, values)  # +-inf are opacities of 1 and 0
        if (bad := bad_rows(values)) is None:
            continue
        first = int(bad.nonzero()[0, 0])
        raise ClodError(f"{what}: {name} is not finite in {int(bad.sum()):,} rows (the first is {first}); {remedy}")


def largest_colour(gaussians: Gaussians) -> str:
    """The largest colour coefficient and its row, for the message about an image that overflows."""
    colours = {name: getattr(gaussians, name).abs().flatten(1) for name in ("sh0", "shN")}
    rows = {name: values.amax(1) for name, values in colours.items() if values.numel()}
    name = max(rows, key=lambda each: float(rows[each].max()))
    value, row = rows[name].max(0)
    return f"the largest {name} is {float(value):.3g}, in row {int(row)}: leave out such rows"
