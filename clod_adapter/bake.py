"""Plain Gaussians from adapted ones: one dial value baked into the opacities; and rows in the order of the dial."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.equation.attenuation import TAKEOVER, Attenuated, dial
from clod_adapter.equation.distances import Place, typical_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import OPAQUE, Gaussians

# Exponents of the dial value that opacities and scales are baked at for several cameras: the best on held-out
# photographs of FADED 0, 0.5, 0.75 and 1, and then of seven GROWN from 0 to 1.25. At equal counts the file is never
# below the dial by more than 0.05 dB, and up to 0.65 dB above it.
FADED, GROWN = 0.75, 0.9


@torch.no_grad()
def bake(
    gaussians: Gaussians, virtual_scale: float, camera: Camera | None = None, *, cameras: Sequence[Place] = ()
) -> Gaussians:
    """The Gaussians that one dial value keeps, with the opacities and scales of that dial value and without a dial.

    ``logit' = log o - log(1 - o)`` with ``o`` the drawn opacity, ``log_scales' = log_scales + log g`` with ``g`` the
    growth (``attenuation.attenuate``); +inf becomes ``OPAQUE``. For one ``camera`` the image from there equals the
    rendering at s. For ``cameras`` each Gaussian has one distance (``distances.typical_distance``): those kept there at
    s are kept, with the opacities of ``s^FADED``, as fading only prevents popping, and then the scales of ``s^GROWN``.

    Args:
        virtual_scale: the dial s >= 0; ``dial_for(gaussians, keep=n, cameras=cameras, baked=True)`` keeps n.
        camera: the one from where the result is exact.
        cameras: instead of ``camera``: the training cameras, or some of them, such as ``load(path).viewpoints``.

    Raises:
        ClodError: no dial, neither or both of camera and cameras, or a value negative, not finite or that keeps none.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so there is no dial value to bake")
    if (camera is None) == (not cameras):
        raise ClodError("bake needs either camera or cameras; load(path).viewpoints are those stored with the file")
    distances = typical_distance(gaussians.means, [camera] if camera else cameras, gaussians.attenuation)
    dialled = dial(gaussians, distances, virtual_scale)
    if not dialled.keep.any():
        raise ClodError(f"no Gaussian is kept at s = {virtual_scale:g}; bake a smaller s")
    shown = dialled if camera else dial(gaussians, distances, virtual_scale**FADED)
    if gaussians.near is not None and not camera:
        dialled, shown = _switched(gaussians, distances, virtual_scale)
    baked = {"opacity_logits": _logits_drawn(shown, gaussians.opacity_logits)}
    if gaussians.growth_d is not None:
        growth = (dialled if camera else dial(gaussians, distances, virtual_scale**GROWN)).growth
        baked["log_scales"] = gaussians.log_scales + growth.log()[:, None]
    plain = gaussians.replace(**baked, sigma_d=None, growth_d=None, attenuation=None)
    return plain.select(dialled.keep)


@torch.no_grad()
def order_by_extinction(gaussians: Gaussians, cameras: Sequence[Place]) -> Tensor:
    """``[N]`` int64, the rows by descending extinction scale ``sigma_d / d``, for renderers that draw a prefix.

    Ties stay in order; where d is 0 it is infinite. With ``gaussians.select(rows)`` the first n are those that ``bake``
    keeps for the cameras.

    Raises:
        ClodError: no dial, no camera, or the paper's form.
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so there is no pruning order")
    if gaussians.near is not None:
        raise ClodError("near and far Gaussians have no order: far ones begin where near ones end; bake dial values")
    if gaussians.attenuation.form == "paper":
        raise ClodError("in the paper's form rows have no order: the cut depends on opacity; adapt with --form ours")
    distances = typical_distance(gaussians.means, cameras, gaussians.attenuation)
    scales = torch.where(distances > 0, gaussians.sigma_d.double() / distances, torch.inf)
    return scales.argsort(descending=True, stable=True)


def baked_rows(gaussians: Gaussians, distances: Tensor, virtual_scale: float) -> Tensor:
    """``[N]`` bool, those that ``bake`` keeps at distances ``[N]`` over several cameras."""
    if gaussians.near is None:
        return dial(gaussians, distances, virtual_scale).keep
    return _switched(gaussians, distances, virtual_scale)[0].keep


def _switched(gaussians: Gaussians, distances: Tensor, virtual_scale: float) -> tuple[Attenuated, Attenuated]:
    """What is kept, and what is drawn of it, if far Gaussians take over from near ones at once, in the middle."""
    assert gaussians.near is not None and gaussians.attenuation is not None and gaussians.sigma_d is not None
    middle = math.sqrt(1 - 0.5 / TAKEOVER) * gaussians.attenuation.near_distance / gaussians.attenuation.scene_distance
    near, far = gaussians.near, distances * virtual_scale >= middle
    whole = gaussians.replace(
        sigma_d=gaussians.sigma_d.masked_fill(near, math.inf),
        attenuation=replace(gaussians.attenuation, near_distance=0.0),
    )
    dialled, shown = (dial(whole, distances, s) for s in (virtual_scale, virtual_scale**FADED))
    return dialled._replace(keep=dialled.keep & (near != far)), shown


def _logits_drawn(shown: Attenuated, logits: Tensor) -> Tensor:
    """``[N]`` the logits of the drawn opacities; bit for bit ``logits`` where these are equal."""
    # By the fade's logarithm, and by expm1 and not 1 - o, which cancels where o is near 1.
    opacities, stored = logits.sigmoid(), torch.nn.functional.logsigmoid(logits)
    drawn = stored + torch.where(opacities > 0, shown.drawn / opacities, 1).log()
    baked = (drawn - torch.log(-torch.expm1(drawn))).clamp(max=OPAQUE)
    same = (drawn == stored) & logits.isfinite()
    return torch.where(same, logits, baked.to(logits))
