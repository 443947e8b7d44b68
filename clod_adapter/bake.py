"""Plain Gaussians from adapted ones: one dial value baked into the opacities."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import MULTIPLIER, require
from clod_adapter.equation.attenuation import (
    Attenuated,
    check_dial,
    dial,
    takeover_distance,
)
from clod_adapter.equation.distances import Place, typical_distance
from clod_adapter.equation.units import nominal_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import OPAQUE, Gaussians
from clod_adapter.initialization.merging import merge

# Exponents of the dial value that opacities and scales are baked at for several cameras: the best
# on held-out photographs of FADED 0, 0.5, 0.75 and 1, and then of seven GROWN from 0 to 1.25. At
# equal counts the file is never below the dial by more than 0.05 dB, and up to 0.65 dB above it.
FADED = 0.75
GROWN = 0.9
MOST = 100.0  # multiplier of the distances at which levels begin
FEWEST = 0.01  # share of the Gaussians in the coarsest level
LEVELS = 16  # the largest number of levels
# Times max_sv and the reference distance, beyond which levels are merged: what is trained there is
# too little, of captures with photographs above all.
TRAINED = 4.0


@torch.no_grad()
def bake(
    gaussians: Gaussians,
    virtual_scale: float,
    camera: Camera | None = None,
    *,
    cameras: Sequence[Place] = (),
) -> Gaussians:
    """The Gaussians that one dial value keeps, with the opacities and scales of that dial value and
    without a dial.

    ``logit' = log o - log(1 - o)`` with ``o`` the drawn opacity,
    ``log_scales' = log_scales + log g`` with ``g`` the growth (``attenuation.attenuate``); +inf
    becomes ``OPAQUE``. For one ``camera`` the image from there equals the rendering at s. For
    ``cameras`` each Gaussian has one distance (``distances.typical_distance``): those kept there at
    s are kept, with the opacities of ``s^FADED``, as fading only prevents popping, and then the
    scales of ``s^GROWN``. Beyond ``max_sv``, where nothing was trained, those of ``max_sv`` are
    merged until as many remain as s keeps (``merging.merge``).

    Args:
        virtual_scale: the dial s >= 0; ``dial_for(gaussians, keep=n, cameras=cameras, baked=True)``
            keeps n.
        camera: the one from where the result is exact.
        cameras: instead of ``camera``: the training cameras, or some of them, such as
            ``load(path).viewpoints``.

    Raises:
        ClodError: no dial, neither or both of camera and cameras, or a value negative, not finite
            or that keeps none.

    Example:
        >>> model = clod.load("model.ply")
        >>> small = clod.bake(model.gaussians, 3, cameras=model.viewpoints)
        >>> clod.save("small.ply", small)
    """
    if gaussians.sigma_d is None or gaussians.attenuation is None:
        raise ClodError("the Gaussians have no sigma_d, so there is no dial value to bake")
    if (camera is None) == (not cameras):
        raise ClodError(
            "bake needs either camera or cameras; load(path).viewpoints are those stored with the"
            " file"
        )
    check_dial(virtual_scale)
    distances = typical_distance(
        gaussians.means, [camera] if camera else cameras, gaussians.attenuation
    )
    if camera:
        kept = shown = grown = dial(gaussians, distances, virtual_scale)
    else:
        kept, shown = _of_several(gaussians, distances, virtual_scale)
        grown = dial(gaussians, distances, virtual_scale**GROWN)
    if not kept.keep.any():
        raise ClodError(f"no Gaussian is kept at s = {virtual_scale:g}; bake a smaller s")
    trained = gaussians.attenuation.max_sv
    if camera or virtual_scale <= trained:
        return _plain(gaussians, kept, shown, grown)
    smallest = bake(gaussians, trained, cameras=cameras)
    return merge(smallest, int(kept.keep.sum()))


class Level(NamedTuple):
    """Plain Gaussians, and the distance in world units from which on they are drawn."""

    begins: float
    gaussians: Gaussians


@torch.no_grad()
def bake_levels(gaussians: Gaussians, multiplier: float = MULTIPLIER) -> list[Level]:
    """Levels for viewers that draw each in a band of distances, the finest first.

    The finest is what s = 0 draws: with near and far Gaussians the checkpoint, bit for bit. Level
    k >= 1 is for the distances from ``H m^(k - 1)`` to ``H m^k``, with m the multiplier and H the
    ``near_distance``, or else the median reach. It has the Gaussians whose reach is beyond the
    middle of its band, ``H m^(k - 1/2)``, with the opacities of its beginning and the scales of its
    middle. The last level has at least FEWEST of the Gaussians. A level that begins beyond TRAINED
    times ``max_sv`` reference distances is the one before it, merged until as many remain
    (``merging.merge``).

    Raises:
        ClodError: no dial, the paper's form, whose distances depend on the view, or a multiplier
            that is not above 1.

    Example:
        >>> model = clod.load("model.ply")
        >>> for k, level in enumerate(clod.bake_levels(model.gaussians)):
        ...     clod.save(f"level_{k}.ply", level.gaussians)
    """
    attenuation = gaussians.attenuation
    if gaussians.sigma_d is None or attenuation is None or attenuation.form == "paper":
        raise ClodError(
            "levels for bands of distance need a dial of the form ours; adapt with --form ours"
        )
    require(1 < multiplier <= MOST, "multiplier", multiplier, f"above 1 and at most {MOST:g}")

    def seen_from(distance: float) -> Attenuated:
        away = torch.full_like(gaussians.means[:, 0], distance / attenuation.scene_distance)
        return dial(gaussians, away, 1.0)

    stored = seen_from(0.0)
    levels = [Level(0.0, _plain(gaussians, stored, stored, stored))]
    begins = (
        attenuation.near_distance or float(gaussians.sigma_d.median()) * attenuation.scene_distance
    )
    typical = nominal_distance(gaussians.means, attenuation) * attenuation.scene_distance
    trained = TRAINED * attenuation.max_sv * typical
    while len(levels) < LEVELS:
        middle = seen_from(begins * math.sqrt(multiplier))
        count = int(middle.keep.sum())
        if count < max(FEWEST * gaussians.whole, 1):
            break
        if begins <= trained:
            level = _plain(gaussians, middle, seen_from(begins), middle)
        else:
            level = merge(levels[-1].gaussians, count)
        levels.append(Level(begins, level))
        begins *= multiplier
    return levels


def _plain(
    gaussians: Gaussians,
    kept: Attenuated,
    shown: Attenuated,
    grown: Attenuated,
) -> Gaussians:
    """Those that are kept, with the opacities that are shown and the scales that are grown, without
    a dial.
    """
    baked = {"opacity_logits": _logits_drawn(shown, gaussians.opacity_logits)}
    if gaussians.growth_d is not None:
        baked["log_scales"] = gaussians.log_scales + grown.growth.log()[:, None]
    return gaussians.replace(**baked, sigma_d=None, growth_d=None, attenuation=None).select(
        kept.keep
    )


def _of_several(
    gaussians: Gaussians,
    distances: Tensor,
    virtual_scale: float,
) -> tuple[Attenuated, Attenuated]:
    """What is kept over several cameras, and what is drawn of it.

    Far Gaussians take over from near ones at once, in the middle of their zone.
    """
    near = gaussians.near
    attenuation = gaussians.attenuation
    whole = gaussians
    if near is not None:  # which do not end by themselves
        assert attenuation is not None and gaussians.sigma_d is not None
        sigma_d = gaussians.sigma_d.masked_fill(near, math.inf)
        whole = gaussians.replace(
            sigma_d=sigma_d, attenuation=replace(attenuation, near_distance=0.0)
        )
    kept, shown = (dial(whole, distances, s) for s in (virtual_scale, virtual_scale**FADED))
    if near is not None:
        assert attenuation is not None
        middle = takeover_distance(attenuation, 0.5)
        kept = kept._replace(keep=kept.keep & (near != (distances * virtual_scale >= middle)))
    return kept, shown


def _logits_drawn(shown: Attenuated, logits: Tensor) -> Tensor:
    """``[N]`` the logits of the drawn opacities; bit for bit ``logits`` where these are equal."""
    # By the fade's logarithm, and by expm1 and not 1 - o, which cancels where o is near 1.
    opacities = logits.sigmoid()
    stored = torch.nn.functional.logsigmoid(logits)
    drawn = stored + torch.where(opacities > 0, shown.drawn / opacities, 1).log()
    baked = (drawn - torch.log(-torch.expm1(drawn))).clamp(max=OPAQUE)
    same = (drawn == stored) & logits.isfinite()
    return torch.where(same, logits, baked.to(logits))
