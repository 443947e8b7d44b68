"""RowAdam is torch's Adam on the selected rows, and does not change the others."""

import pytest
import torch
from torch import Tensor

from clod_adapter.training.optimizer import RowAdam

SHAPES = {"means": (3,), "quats": (4,), "opacity_logits": (), "sh0": (1, 3), "shN": (24, 3), "none": (0, 3)}
TENTHS = dict.fromkeys(SHAPES, 0.1)


class PlainRowAdam(RowAdam):
    """RowAdam without the fused kernel."""

    def _step_fused(self, gradients: dict[str, Tensor], rows: Tensor, rates: dict[str, float]) -> None:
        self._step_plain(gradients, rows, rates)


def parameters(n: int, seed: int = 0) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {name: torch.randn(n, *shape, generator=g) for name, shape in SHAPES.items()}


def gradients(n: int, seed: int) -> dict[str, Tensor]:
    """Gradients over many orders of magnitude, with some zeros."""
    g = torch.Generator().manual_seed(seed)
    out = {}
    for name, shape in SHAPES.items():
        size = 10 ** (8 * torch.rand(n, *[1] * len(shape), generator=g) - 6)
        out[name] = torch.randn(n, *shape, generator=g) * size * (torch.rand(n, *shape, generator=g) > 0.1)
    return out


def everything(n: int) -> Tensor:
    return torch.ones(n, dtype=torch.bool)


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
@pytest.mark.parametrize(
    ("steps", "beta1", "beta2", "epsilon"), [(12, 0.9, 0.999, 1e-15), (90, 0.5, 0.8, 1e-2)],
    ids=["defaults", "past the last bias correction that is stored, the 79th"],
)  # fmt: skip
def test_all_rows_match_torch_adam(
    kind: type[RowAdam], steps: int, beta1: float, beta2: float, epsilon: float, n: int = 57
) -> None:
    """In units: the rates of rows are multiplied by them."""
    ours, theirs = parameters(n), {name: p.requires_grad_() for name, p in parameters(n).items()}
    units = torch.linspace(0.1, 2, n)
    optimizer = kind(ours, beta1=beta1, beta2=beta2, epsilon=epsilon, units={"means": units})
    adam = torch.optim.Adam(theirs.values(), lr=0.02, betas=(beta1, beta2), eps=epsilon)
    for step in range(steps):
        optimizer.step(gradients(n, step), everything(n), dict.fromkeys(SHAPES, 0.02))
        for name, gradient in gradients(n, step).items():
            theirs[name].grad = gradient
        adam.step()
    close = {"rtol": 1e-5, "atol": 1e-5} if steps > 12 else {"rtol": 2e-6, "atol": 2e-6}
    for name, start in parameters(n).items():
        moved = (theirs[name] - start).detach() * (units[:, None] if name == "means" else 1)
        torch.testing.assert_close(ours[name], start + moved, **close)


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
@pytest.mark.parametrize(("more", "filler"), [(0, torch.inf), (11, torch.nan)])
def test_only_selected_rows_are_stepped(kind: type[RowAdam], more: int, filler: float, n: int = 40) -> None:
    """Other rows keep every bit, and their gradients are ignored; so do rows behind a leading part."""
    larger, alone = parameters(n + more), {name: value[:n] for name, value in parameters(n + more).items()}
    larger["means"][5] = torch.nan
    before = {name: value.clone().view(torch.int32) for name, value in larger.items()}
    rows = torch.zeros(n, dtype=torch.bool)
    rows[[31, 2, 17]] = True
    own = {name: value[rows].clone() for name, value in alone.items()}
    optimizers = kind({name: value[:n] for name, value in larger.items()}), kind(own)
    for step in range(3):
        given = {name: gradient + 1 for name, gradient in gradients(n, step).items()}
        optimizers[1].step({name: value[rows] for name, value in given.items()}, everything(3), TENTHS)
        for value in given.values():
            value[~rows] = filler
        optimizers[0].step(given, rows, TENTHS)
        optimizers[0].step(given, torch.zeros_like(rows), TENTHS)  # of no rows
    for name, value in larger.items():
        bits, others = value.view(torch.int32), torch.cat([~rows, torch.ones(more, dtype=torch.bool)])
        assert torch.equal(bits[others], before[name][others]), name  # in place
        assert (bits[~others] != before[name][~others]).all() and torch.equal(value[~others], own[name]), name
