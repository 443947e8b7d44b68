"""Far Gaussians: fewer, merged ones, which take over from the checkpoint's own where these are far
away.

Without photographs the checkpoint is the truth, and what training changes is loss where nothing is
left out. So its own Gaussians stay as they are, and are drawn up to ``near_distance``; from there
on far Gaussians are, which start as merged ones (``initialization/merging.py``) and are trained for
their own distances alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from clod_adapter.cameras import View, spread
from clod_adapter.config import AdaptConfig
from clod_adapter.equation.distances import normalized_distances, typical_distance
from clod_adapter.equation.units import in_world_units
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians, with_near
from clod_adapter.initialization.importance import (
    MOST_VIEWS,
    has_dial,
    importance,
    initialize,
    reach_of,
    scene_distance,
    with_growth,
)
from clod_adapter.initialization.merging import merge
from clod_adapter.initialization.pruning_order import pruning_order
from clod_adapter.progress import Listener
from clod_adapter.training.pseudo_views import PseudoView, only_pseudo

# The number of far Gaussians as a share of the near ones', and the share of the distances in all
# views that are below near_distance. Trained on photographs, far Gaussians are better than the
# checkpoint's own from the nearest ones on. Of a checkpoint that is itself the truth none is
# better, and fewer far ones do for small budgets.
SHARE, NEARER = 0.8, 0.05
FEW_SHARE = 1.0  # beside few photographs: what training cannot learn anew is not merged away
PLACED_SHARE, PLACED_NEARER = 0.4, 0.6
# Exponent of the importance in merging. A dense checkpoint has many Gaussians that no placed view
# shows larger than a pixel: these are merged first, and those that matter stay as they are.
PLACED_CONTRAST = 3.0
LONGER = 1.2  # times near_distance, the smallest reach
SAMPLE = 20_000  # Gaussians whose distances tell near_distance
WITHOUT_FAR = (
    "the checkpoint's dial has no far Gaussians, as of a training loop or the paper's form; adapt a"
    " plain file"
)


def with_far(
    base: Gaussians,
    views: Sequence[View],
    config: AdaptConfig,
    progress: Listener | None = None,
) -> Gaussians:
    """The base's Gaussians as near ones, and after them far ones with an initial reach; in world
    units.

    A far Gaussian ends where the number of those that matter more is the target count; its
    importance is measured as ``importance.initialize`` does. Near and far Gaussians that the base
    already has are continued from.

    Raises:
        ClodError: the base has a dial without far Gaussians.
    """
    if base.near is not None:
        return initialize(base, views, config)
    if has_dial(base):
        raise ClodError(WITHOUT_FAR)
    placed = only_pseudo(views)
    if not placed:  # else each camera shows what others do not
        views = spread(views, MOST_VIEWS)
    share, nearer, contrast = SHARE, NEARER, 1.0
    if placed:
        share, nearer, contrast = PLACED_SHARE, PLACED_NEARER, PLACED_CONTRAST
    elif any(isinstance(view, PseudoView) for view in views):
        share = FEW_SHARE
    cameras = [view.camera for view in views]
    attenuation = config.attenuation(scene_distance(base, views))
    some = base.means[:: len(base) // SAMPLE + 1]
    distances = torch.cat([normalized_distances(some, camera, attenuation) for camera in cameras])
    near = float(distances.kthvalue(max(round(nearer * len(distances)), 1)).values)
    # placed cameras do not show everything
    weights = importance(base, cameras, unseen=placed, seed=config.seed, progress=progress)
    far = merge(base, max(round(share * len(base)), 1), weights.double() ** contrast, progress)
    far_weights = importance(far, cameras, seed=config.seed, progress=progress)
    order = pruning_order(far, far_weights, progress)
    distances = typical_distance(far.means, cameras, attenuation)
    reach = reach_of(order, distances, replace(config, start_share=1.0), len(base))
    reach = reach.clamp(min=LONGER * near)
    attenuation = replace(attenuation, near_distance=near * attenuation.scene_distance)
    far = with_growth(far.replace(sigma_d=reach, attenuation=attenuation), config)
    return in_world_units(with_near(base, far))
