"""The parameters of gsplat's trainer and of splatfacto, as Gaussians and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from clod_adapter.config import ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.integrations.splats import from_gsplat, to_gsplat
from scenes import gaussians


def test_a_round_trip_shares_the_tensors() -> None:
    some = gaussians(7, 2, 0)
    splats = to_gsplat(some)
    assert list(splats) == ["means", "quats", "scales", "opacities", "sh0", "shN"]
    again = from_gsplat(torch.nn.ParameterDict(splats), screen_filter=ScreenFilter(compensate=True))
    assert again.screen_filter.compensate and again.sigma_d is None
    for name, value in some.tensors().items():
        assert getattr(again, name).data_ptr() == value.data_ptr(), name


def test_splatfacto() -> None:
    some = gaussians(7, 1, 0)
    named = to_gsplat(some)
    named |= {"features_dc": named.pop("sh0")[:, 0], "features_rest": named.pop("shN")}
    named["opacities"] = named["opacities"][:, None].requires_grad_()
    again = from_gsplat(named)
    for name, value in some.tensors().items():
        assert torch.equal(getattr(again, name), value), name
    again.opacities.sum().backward()
    assert named["opacities"].grad.shape == (7, 1)


@pytest.mark.parametrize("rest", [True, False])
def test_splatfacto_without_higher_degrees_has_logits_of_colours(rest: bool) -> None:
    named = to_gsplat(gaussians(3, 0, 0))
    del named["sh0"], named["shN"]
    named["features_dc"] = torch.tensor([[0.0, 1.0, -1.0]]).repeat(3, 1)
    if rest:
        named["features_rest"] = torch.zeros(3, 0, 3)
    shown = from_gsplat(named)
    torch.testing.assert_close(0.5 + 0.28209479177 * shown.sh0[:, 0], named["features_dc"].sigmoid())
    assert shown.sh_degree == 0


def test_arrays_become_float32() -> None:
    some = gaussians(5, 1, 0)
    again = from_gsplat({name: value.double().numpy() for name, value in to_gsplat(some).items()})
    assert all(value.dtype == torch.float32 for value in again.tensors().values())
    np.testing.assert_array_equal(again.means.numpy(), some.means.numpy())


def test_what_is_missing_is_named() -> None:
    named = to_gsplat(gaussians(5, 1, 0))
    named["features"] = named.pop("sh0")
    with pytest.raises(ClodError, match=r"splats needs sh0 too, it has means, .*; with appearance optimisation"):
        from_gsplat(named)
    with pytest.raises(ClodError, match=r"opacity_logits has shape \(5, 2\)"):
        from_gsplat(to_gsplat(gaussians(5, 1, 0)) | {"opacities": torch.zeros(5, 2)})
