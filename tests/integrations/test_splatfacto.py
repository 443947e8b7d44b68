"""What the nerfstudio method computes, on splatfacto's parameters as plain tensors."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import scenes
from clod_adapter import load
from clod_adapter.cameras import Camera
from clod_adapter.config import FILTERS, AdaptConfig
from clod_adapter.equation.units import in_world_units
from clod_adapter.errors import ClodError
from clod_adapter.nerfstudio.splatfacto import chosen, new_dial, shown, state_of, view_of, write_ply
from clod_adapter.render import render
from clod_adapter.training.dial import Dial

N, WIDTH, HEIGHT = 60, 32, 24
CONFIG = AdaptConfig(max_sv=5.0)


def splatfacto(seed: int = 0) -> dict[str, Tensor]:
    """Parameters with the names and shapes of splatfacto's ``gauss_params``."""
    base = scenes.gaussians(N, 1, seed, size=0.15)
    values = {
        "means": base.means, "scales": base.log_scales, "quats": base.quats, "features_dc": base.sh0[:, 0],
        "features_rest": base.shN, "opacities": base.opacity_logits[:, None],
    }  # fmt: skip
    return {name: value.clone().requires_grad_() for name, value in values.items()}


def cameras_of(view: Camera) -> SimpleNamespace:
    """A camera as nerfstudio's ``Cameras`` hold it: one row, OpenGL's axes, no last row of the pose."""
    pose = torch.linalg.inv(view.viewmat)[:3] * torch.tensor([1.0, -1.0, -1.0, 1.0])
    values = {"fx": view.K[0, 0], "fy": view.K[1, 1], "cx": view.K[0, 2], "cy": view.K[1, 2]}
    sizes = {"width": torch.tensor([[view.width]]), "height": torch.tensor([[view.height]])}
    return SimpleNamespace(camera_to_worlds=pose[None], **sizes, **{k: v.reshape(1, 1) for k, v in values.items()})


@pytest.fixture(scope="module")
def views() -> list[Any]:
    return [view_of(cameras_of(each)) for each in scenes.ring(6, WIDTH, HEIGHT)]


@pytest.fixture
def parameters() -> dict[str, Tensor]:
    return splatfacto()


@pytest.fixture
def dial(parameters: dict[str, Tensor], views: list[Any]) -> Dial:
    return new_dial(parameters, views, CONFIG, {})


def test_cameras_are_nerfstudios(views: list[Any]) -> None:
    for view, want in zip(views, scenes.ring(6, WIDTH, HEIGHT), strict=True):
        torch.testing.assert_close(view.camera.viewmat, want.viewmat)
        torch.testing.assert_close(view.camera.K, want.K)
        assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)


def test_splatfacto_draws_what_render_draws(parameters: dict[str, Tensor], dial: Dial, views: list[Any]) -> None:
    """Activated as splatfacto does, the changed parameters give the picture of the adapted Gaussians."""
    camera = views[0].camera
    for scale in (1.0, 3.0):
        changed = shown(parameters, dial, camera, scale)
        assert {name: value.shape for name, value in changed.items()} == {
            name: parameters[name].shape for name in ("means", "opacities", "scales")
        }
        model = dial.gaussians()
        plain = model.replace(sigma_d=None, growth_d=None, attenuation=None)
        drawn = plain.replace(
            means=changed["means"], log_scales=changed["scales"], opacity_logits=changed["opacities"][:, 0].nan_to_num()
        )
        torch.testing.assert_close(render(drawn, camera).image, render(model, camera, scale).image, rtol=0, atol=1e-5)


def test_culled_rows_are_behind_the_camera_with_gradient_0(
    parameters: dict[str, Tensor], dial: Dial, views: list[Any]
) -> None:
    camera = views[1].camera
    changed = shown(parameters, dial, camera, 5.0)
    keep = dial(camera, 5.0).keep
    assert 0 < int(keep.sum()) < N
    depths = changed["means"] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    torch.testing.assert_close(depths[~keep], torch.full((int((~keep).sum()),), -1.0))
    assert torch.equal(changed["means"][keep], parameters["means"][keep])
    assert torch.equal(changed["opacities"].sigmoid()[~keep], torch.zeros(int((~keep).sum()), 1))
    sum(value.exp().sum() if name == "scales" else value.sigmoid().sum() for name, value in changed.items()).backward()
    for name in ("means", "opacities"):
        gradient = parameters[name].grad
        assert gradient is not None and gradient.isfinite().all() and not gradient[~keep].any()
        assert gradient[keep].any()
    assert dial.log_sigma.grad is not None and dial.log_sigma.grad.isfinite().all() and dial.log_sigma.grad.any()


def test_an_opaque_gaussian_has_finite_gradients(parameters: dict[str, Tensor], dial: Dial, views: list[Any]) -> None:
    """sigmoid(30) is 1 in float32, whose logit is infinite."""
    parameters["opacities"].data[:] = 30.0
    dial.log_sigma.data[:] = 10.0
    changed = shown(parameters, dial, views[0].camera, 1.0)
    changed["opacities"].sigmoid().sum().backward()
    assert parameters["opacities"].grad is not None and parameters["opacities"].grad.isfinite().all()


def test_a_saved_dial_is_the_same_dial(parameters: dict[str, Tensor], dial: Dial, views: list[Any]) -> None:
    state = state_of(dial)
    again = new_dial(parameters, views, CONFIG, state)
    scenes.assert_equal(again.gaussians(), dial.gaussians())
    torch.testing.assert_close(again.typical, dial.typical)
    with pytest.raises(ClodError, match="trained up to 5; set --pipeline.model.max-sv"):
        new_dial(parameters, views, AdaptConfig(max_sv=7.0), state)


def test_its_state_is_read_without_running_code(dial: Dial, tmp_path: Any) -> None:
    """As nerfstudio's commands read checkpoints with today's torch."""
    torch.save(state_of(dial), tmp_path / "dial.ckpt")
    assert torch.load(tmp_path / "dial.ckpt", weights_only=True).keys() == state_of(dial).keys()


def test_the_dial_value_of_the_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CLOD_VIRTUAL_SCALE", raising=False)
    assert chosen(2.0) == 2.0
    monkeypatch.setenv("CLOD_VIRTUAL_SCALE", "3.5")
    assert chosen(2.0) == 3.5
    for text in ("far", "-0.5"):
        monkeypatch.setenv("CLOD_VIRTUAL_SCALE", text)
        with pytest.raises(ClodError, match=f"CLOD_VIRTUAL_SCALE is '{text}', it must be a number of at least 0"):
            chosen(2.0)


def test_rows_that_nerfstudio_drops_have_no_dial_in_the_file(dial: Dial, tmp_path: Any) -> None:
    """Columns as ns-export has them: some ``[M]``, some ``[M, 1]``, with rows missing."""
    with torch.no_grad():
        own = in_world_units(dial.gaussians())
    keep = torch.arange(N) % 3 != 1
    columns: dict[str, Any] = {name: own.means[keep, i].detach().numpy() for i, name in enumerate("xyz")}
    columns["opacity"] = own.opacity_logits[keep, None].detach().numpy()
    path = tmp_path / "splat.ply"
    write_ply(str(path), columns, dial, FILTERS["on"])
    found = load(path).gaussians
    assert found.attenuation == own.attenuation and found.screen_filter == FILTERS["on"]
    for name, value in found.tensors().items():
        torch.testing.assert_close(value, own.tensors()[name][keep].detach(), rtol=1e-6, atol=0)
    with pytest.raises(ClodError, match="exports other rows than those of the dial"):
        write_ply(str(path), {name: np.flip(value, 0) for name, value in columns.items()}, dial, FILTERS["on"])
