"""The parameters of gsplat's trainer and of splatfacto as Gaussians, and what the nerfstudio method
makes of them.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from refusals import refused

import scenes
from clod_adapter import load
from clod_adapter.config import FILTERS, AdaptConfig, ScreenFilter
from clod_adapter.equation.units import in_world_units
from clod_adapter.integrations.splats import from_gsplat, to_gsplat
from clod_adapter.nerfstudio.splatfacto import (
    camera_of,
    chosen,
    drawn_parameters,
    new_dial,
    state_of,
    write_ply,
)
from clod_adapter.render import render

N, WIDTH, HEIGHT = 60, 32, 24
CONFIG = AdaptConfig(max_sv=5.0)
BASE = scenes.gaussians(N, 1, 0, size=0.15)


@pytest.fixture
def parameters():
    """``BASE`` with the names and shapes of splatfacto's ``gauss_params``."""
    named = scenes.splatfacto_parameters(BASE)
    return {name: value.clone().requires_grad_() for name, value in named.items()}


def test_parameters_are_shared(parameters):
    """Those of gsplat's trainer, as tensors or arrays, and of splatfacto, whose colours are logits
    at SH degree 0.
    """
    splats = to_gsplat(BASE)
    assert list(splats) == ["means", "quats", "scales", "opacities", "sh0", "shN"]
    again = from_gsplat(torch.nn.ParameterDict(splats), screen_filter=ScreenFilter(compensate=True))
    assert again.screen_filter.compensate and again.sigma_d is None
    scenes.assert_equal(
        from_gsplat({name: value.double().numpy() for name, value in splats.items()}), BASE
    )
    for name, value in BASE.tensors().items():
        assert getattr(again, name).data_ptr() == value.data_ptr(), name
    named = parameters
    scenes.assert_equal(from_gsplat(named), BASE)
    from_gsplat(named).opacities.sum().backward()
    assert named["opacities"].grad.shape == (N, 1)
    del named["features_rest"]
    for rest in ({}, {"features_rest": torch.zeros(N, 0, 3)}):
        colours = from_gsplat(named | rest)
        torch.testing.assert_close(
            0.5 + 0.28209479177 * colours.sh0[:, 0], named["features_dc"].sigmoid()
        )
        assert colours.sh_degree == 0
    with refused(r"opacity_logits has shape \(60, 2\)"):
        from_gsplat(splats | {"opacities": torch.zeros(N, 2)})
    splats["features"] = splats.pop("sh0")
    with refused(r"splats needs sh0 too, it has means, .*; with appearance optimisation"):
        from_gsplat(splats)


def cameras_of(view):
    """A camera as nerfstudio's ``Cameras`` hold it: one row, OpenGL's axes, no last row of the
    pose.
    """
    pose = torch.linalg.inv(view.viewmat)[:3] * torch.tensor([1.0, -1.0, -1.0, 1.0])
    values = {"fx": view.K[0, 0], "fy": view.K[1, 1], "cx": view.K[0, 2], "cy": view.K[1, 2]}
    sizes = {"width": torch.tensor([[view.width]]), "height": torch.tensor([[view.height]])}
    return SimpleNamespace(
        camera_to_worlds=pose[None], **sizes, **{k: v.reshape(1, 1) for k, v in values.items()}
    )


@pytest.fixture(scope="module")
def cameras():
    return [camera_of(cameras_of(each)) for each in scenes.ring(6, WIDTH, HEIGHT)]


@pytest.fixture
def dial(parameters, cameras):
    return new_dial(parameters, cameras, CONFIG, {})


def test_cameras_are_nerfstudios(cameras):
    for camera, want in zip(cameras, scenes.ring(6, WIDTH, HEIGHT), strict=True):
        torch.testing.assert_close(camera.viewmat, want.viewmat)
        torch.testing.assert_close(camera.K, want.K)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)


def test_splatfacto_draws_what_render_draws(parameters, dial, cameras):
    """Activated as it does: sigmoid(30) is 1 in float32, with an infinite logit. Culled rows are
    behind the camera.
    """
    parameters["opacities"].data[0], dial.log_sigma.data[0] = 30.0, 10.0
    camera, model = cameras[1], dial.gaussians()
    plain = model.replace(sigma_d=None, growth_d=None, attenuation=None)
    for scale in (1.0, 5.0):
        changed = drawn_parameters(parameters, dial, camera, scale)
        assert all(value.shape == parameters[name].shape for name, value in changed.items())
        logits = changed["opacities"][:, 0].nan_to_num()
        drawn = plain.replace(
            means=changed["means"], log_scales=changed["scales"], opacity_logits=logits
        )
        torch.testing.assert_close(
            render(drawn, camera).image, render(model, camera, scale).image, rtol=0, atol=1e-5
        )
    keep = dial(camera, 5.0).keep
    assert 0 < int(keep.sum()) < N
    depths = changed["means"] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    assert (
        torch.allclose(depths[~keep], torch.tensor(-1.0))
        and not changed["opacities"].sigmoid()[~keep].any()
    )
    assert torch.equal(changed["means"][keep], parameters["means"][keep])
    sum(
        value.exp().sum() if name == "scales" else value.sigmoid().sum()
        for name, value in changed.items()
    ).backward()
    for value in (parameters["means"], parameters["opacities"]):
        assert (
            value.grad.isfinite().all() and not value.grad[~keep].any() and value.grad[keep].any()
        )
    assert dial.log_sigma.grad.isfinite().all() and dial.log_sigma.grad.any()


def test_a_saved_dial_is_the_same_dial(parameters, dial, cameras, tmp_path):
    """Its state is read without running code, as nerfstudio's commands read checkpoints with
    today's torch.
    """
    torch.save(state_of(dial), tmp_path / "dial.ckpt")
    state = torch.load(tmp_path / "dial.ckpt", weights_only=True)
    again = new_dial(parameters, cameras, CONFIG, state)
    scenes.assert_equal(again.gaussians(), dial.gaussians())
    torch.testing.assert_close(again.typical, dial.typical)
    with refused("trained up to 5; set --pipeline.model.max-sv"):
        new_dial(parameters, cameras, AdaptConfig(max_sv=7.0), state)


def test_the_dial_value_of_the_commands(monkeypatch):
    monkeypatch.delenv("CLOD_VIRTUAL_SCALE", raising=False)
    assert chosen(2.0) == 2.0
    monkeypatch.setenv("CLOD_VIRTUAL_SCALE", "3.5")
    assert chosen(2.0) == 3.5
    for text in ("far", "-0.5"):
        monkeypatch.setenv("CLOD_VIRTUAL_SCALE", text)
        with refused(f"CLOD_VIRTUAL_SCALE is '{text}', it must be a number of at least 0"):
            chosen(2.0)


def test_rows_that_nerfstudio_drops_have_no_dial_in_the_file(dial, tmp_path):
    """Columns as ns-export has them: some ``[M]``, some ``[M, 1]``, with rows missing."""
    with torch.no_grad():
        own = in_world_units(dial.gaussians())
    keep = torch.arange(N) % 3 != 1
    columns = {name: own.means[keep, i].detach().numpy() for i, name in enumerate("xyz")}
    columns["opacity"] = own.opacity_logits[keep, None].detach().numpy()
    path = tmp_path / "splat.ply"
    write_ply(str(path), columns, dial, FILTERS["on"])
    found = load(path).gaussians
    assert found.attenuation == own.attenuation and found.screen_filter == FILTERS["on"]
    for name, value in found.tensors().items():
        torch.testing.assert_close(value, own.tensors()[name][keep].detach(), rtol=1e-6, atol=0)
    with refused("exports other rows than those of the dial"):
        write_ply(
            str(path),
            {name: np.flip(value, 0) for name, value in columns.items()},
            dial,
            FILTERS["on"],
        )
