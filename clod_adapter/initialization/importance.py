"""Initialization without training: each Gaussian's contribution to the views, and the sigma_d from
its rank.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from clod_adapter.cameras import Camera, View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.attenuation import SIGMA_MAX
from clod_adapter.equation.distances import median_distance, typical_distance
from clod_adapter.equation.units import in_world_units, known_distance, with_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians, largest_colour, nonfinite_rows
from clod_adapter.initialization.pruning_order import pruning_order
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.rasterizers import ALPHA_MAX
from clod_adapter.render import splat

# Times the largest dial value, the largest extinction scale: beyond, a reach has no gradient in
# training, and would never change.
WIDEST = 4.0
# Most photographs whose cameras are rendered: twice as many changed the trained result by 0.01 to
# 0.04 dB.
MOST_VIEWS = 64
NEAREST_VIEWS = 0.05  # share of the views that may be nearer than where growth begins


def initialize(
    base: Gaussians,
    views: Sequence[View],
    config: AdaptConfig,
    progress: Listener | None = None,
) -> Gaussians:
    """The Gaussians with an initial sigma_d, in world units, and growth_d, from up to MOST_VIEWS
    evenly spread views.

    A dial that ``base`` already has, with any effect, is kept with its own settings except the
    config's ``max_sv``.
    """
    views = spread(views, MOST_VIEWS)
    if base.attenuation is not None and has_dial(base):
        if base.attenuation.form != config.form:
            raise ClodError(
                f"the dial has the form {base.attenuation.form}; adapt with the same, or give a"
                " plain file"
            )
        distance = known_distance(base.attenuation) or scene_distance(base, views)
        settings = replace(base.attenuation, max_sv=config.max_sv, reference_distance=distance)
        kept = base.replace(attenuation=settings)
        return in_world_units(with_growth(kept, config, base.growth_d))
    attenuation = config.attenuation(scene_distance(base, views))
    cameras = [view.camera for view in views]
    weights = importance(base, cameras, seed=config.seed, progress=progress)
    order = pruning_order(base, weights, progress)
    distances = typical_distance(base.means, cameras, attenuation)
    initial = base.replace(sigma_d=reach_of(order, distances, config), attenuation=attenuation)
    return in_world_units(with_growth(initial, config))


def importance(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    unseen: bool = False,
    seed: int = 0,
    progress: Listener | None = None,
) -> Tensor:
    """``[N]`` the weight of each Gaussian in the images of ``cameras``: the root of its
    ``removal_error``, times its opacity.

    Args:
        unseen: what no camera shows matters too, as much as what is shown.
    """
    error = removal_error(gaussians, cameras, seed=seed, progress=progress)
    if unseen:
        error = _supposed_error(gaussians, error)
    return error.sqrt() * gaussians.opacities


def reach_of(
    order: Tensor,
    distances: Tensor,
    config: AdaptConfig,
    total: int | None = None,
) -> Tensor:
    """``[N]`` sigma_d from the pruning order, in the unit of the typical ``distances [N]``;
    ``total`` as for ``extinction_from_rank``.
    """
    scales = extinction_from_rank(order.max() - order, config, total)
    return distances * scales.clamp(max=WIDEST * config.max_sv)


def with_growth(
    initial: Gaussians,
    config: AdaptConfig,
    growth_d: Tensor | None = None,
) -> Gaussians:
    """``initial`` with ``growth_d``, by default 0; without one if the config has no growth."""
    if config.growth == "off":
        growth_d = None
    elif growth_d is None:
        growth_d = torch.zeros_like(initial.opacity_logits)
    return initial.replace(growth_d=growth_d)


def for_training(initial: Gaussians) -> Gaussians:
    """The result of ``initialize`` with sigma_d in units of the reference distance, which it has
    unless that is 1.
    """
    assert initial.attenuation is not None
    distance = known_distance(initial.attenuation) or 1.0
    attenuation = replace(initial.attenuation, reference_distance=distance)
    return with_distance(initial.replace(attenuation=attenuation), distance)


def has_dial(base: Gaussians) -> bool:
    """Whether there is a dial with any effect."""
    grows = base.growth_d is not None and bool(base.growth_d.any())
    return base.sigma_d is not None and (grows or bool((base.sigma_d < SIGMA_MAX).any()))


def usable_views(base: Gaussians, views: Sequence[View]) -> tuple[View, ...]:
    """The views with at least one Gaussian's centre beyond their near plane; the others render
    nothing.
    """

    def sees(camera: Camera) -> bool:
        return bool((camera.depths(base.means) >= camera.near).any())

    usable = tuple(view for view in views if sees(view.camera))
    if not usable:
        raise ClodError(
            f"no Gaussian is in front of any of the {len(views)} training cameras: checkpoint and"
            " cameras are not of one scene, or not in one coordinate frame; give the photographs"
            " and poses it was trained on"
        )
    return usable


def scene_distance(base: Gaussians, views: Sequence[View]) -> float:
    """D of training, world units: the median distance in the frustum, of the nearest views.

    The farthest of the NEAREST_VIEWS share of the views, and at least the second nearest of three
    or more. Growth begins there: nearer, stored scales and opacities must fill the gaps
    (docs/method.md, "Near to far").
    """
    medians = sorted(median_distance(base.means, view.camera) for view in views)
    second = 1 if len(medians) > 2 else 0
    return medians[max(math.ceil(NEAREST_VIEWS * len(medians)) - 1, second)]


def removal_error(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    seed: int = 0,
    progress: Listener | None = None,
) -> Tensor:
    """``[N]`` estimate of the squared image error of removing each Gaussian alone, mean over the
    cameras.

    To first order removing Gaussian i changes pixel p by ``a_i dC_p/da_i``. The sum of squares over
    the pixels is estimated without bias by one backward pass per camera: with random signs z,
    ``E[(sum_p z_p dC_p/da_i)^2] = sum_p (dC_p/da_i)^2`` (Hutchinson). Images have half the size,
    unless they are small, in a third of the time.
    """
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros_like(gaussians.means[:, 0])
    smaller = gaussians.replace(screen_filter=gaussians.screen_filter.halved())
    for done, camera in enumerate(cameras, 1):
        opacities = gaussians.opacities.detach().requires_grad_()
        if camera.halvable:
            image, _ = splat(smaller, opacities, camera.halved())
        else:
            image, _ = splat(gaussians, opacities, camera)
        bits = torch.randint(0, 2, image.shape, generator=generator, dtype=torch.uint8)
        signs = bits.to(image.device).to(image) * 2 - 1
        # as grad_outputs they would import sympy
        (gradient,) = torch.autograd.grad((image * signs).sum(), opacities)
        total += (gradient * opacities.detach()).square()
        tell(progress, Phase.IMPORTANCE, done, len(cameras))
    count = int(nonfinite_rows(total).sum())
    if count:
        raise ClodError(
            f"the image error of removing each of {count:,} Gaussians is not finite;"
            f" {largest_colour(gaussians)}"
        )
    return total / max(len(cameras), 1)


def extinction_from_rank(rank: Tensor, config: AdaptConfig, total: int | None = None) -> Tensor:
    """``[N]`` the dial values at which Gaussians are culled, so that counts follow the target-count
    curve.

    The Gaussian of ``rank`` (0 the most important, integers below N) is culled where
    ``target_count.target_curve`` falls to its share of the ranks, or of ``total``. Ranks beyond
    ``config.start_share`` are culled before s = 1.
    """
    share = (rank.double() + 0.5) / (total or len(rank))
    discriminant = share**-2 - 4 * (1 / config.start_share - 1)
    power = (1 / share + discriminant.clamp(min=0).sqrt()) / 2
    above = power ** (1 / config.exponent)
    below = config.start_share / share
    return torch.where(share <= config.start_share, above, below).float()


def coverage(
    gaussians: Gaussians,
    opacities: Tensor,
    camera: Camera,
    growth: Tensor | None = None,
) -> Tensor:
    """``[N]`` pixels that each Gaussian covers: the gradient of the image by its colour."""
    grey = gaussians.sh0.new_zeros(gaussians.sh0.shape).requires_grad_()
    plain = gaussians.replace(sh0=grey, shN=gaussians.shN[:, :0])
    image, _ = splat(plain, opacities, camera, growth=growth)
    (gradient,) = torch.autograd.grad(image[..., 0].sum(), grey)
    return gradient[:, 0, 0] / SH_C0


def _supposed_error(gaussians: Gaussians, error: Tensor) -> Tensor:
    """``[N]`` the error; of one that no view shows that of a shown one of equal ``opacity^2 area``,
    in the median.

    Rasterizers clamp alpha, where it has no derivative: Gaussians that opaque count as shown.
    """
    shown = (error > 0) | (gaussians.opacities > ALPHA_MAX)
    area = gaussians.log_scales.sum(1) - gaussians.log_scales.amin(1)
    expected = gaussians.opacities.square() * (area - area.median()).clamp(-30, 30).exp()
    measured = shown & (error > 0)
    if not bool(measured.any()):
        return error
    return torch.where(shown, error, expected * (error[measured] / expected[measured]).median())
