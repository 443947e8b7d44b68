"""Pseudo views: placed cameras, with the checkpoint's own renderings as photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
import torch

from clod_adapter.cameras import Camera, Scene, StoredView, View
from clod_adapter.equation.distances import median_distance
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import render
from clod_adapter.training.camera_placement import SAMPLE, place_cameras

# To fewer than MANY photographs ADDED pseudo views are added: up to half of them at the cameras of
# the photographs, at most MOST_NEARBY at each, from where they are moved WIDER; the others at
# placed cameras. Photographs are shown as often as those at their cameras.
MANY = 64
ADDED = 96
MOST_NEARBY = 4
WIDER = 2.0
TEST_EVERY = 8  # as with photographs
MOVED = 0.1  # standard deviation of a camera's random offset, of its distance to the scene
TURNED = 0.05  # standard deviation of its direction, radians
ZOOMED = 0.15  # largest change of the logarithm of its focal length
# Without photographs a share BACKED of the moved cameras also steps back, log-uniformly up to
# FARTHER reaches from the scene: a dial that was learned near the scene only loses what is small in
# the distance.
BACKED = 1 / 3
FARTHER = 4.0


class PseudoView(StoredView):
    """A view whose photograph is a rendering of ``supervision``, made when it is read, and from
    nearby in each step.

    With a fixed set of renderings Gaussians drift towards what only these cameras see. ``at``
    returns a fixed one. ``reach`` is the unit of a moved camera's offset (``reaches``), ``backed``
    the share that step back as well.
    """

    def __init__(
        self,
        camera: Camera,
        supervision: Gaussians,
        reach: float,
        backed: float = 0.0,
    ) -> None:
        super().__init__(camera, lambda: render(supervision, camera).pixels.cpu())
        self.__dict__.update(supervision=supervision, reach=reach, backed=backed)

    supervision: Gaussians
    reach: float
    backed: float

    def __reduce__(self) -> tuple[type[PseudoView], tuple[Any, ...]]:  # type: ignore[override]
        return PseudoView, (self.camera, self.supervision, self.reach, self.backed)

    def moved(self, random: np.random.Generator) -> View:
        """A view from a random camera near this one, or behind it; rendered when its image is
        read.
        """
        x, y, z = TURNED * random.standard_normal(3)
        step = torch.eye(4, dtype=torch.float64)  # on the CPU, where cameras are placed
        rows = [
            [0, -z, y],
            [z, 0, -x],
            [-y, x, 0],
        ]
        turn = torch.tensor(rows, dtype=torch.float64)
        step[:3, :3] = turn.matrix_exp()
        step[:3, 3] = torch.from_numpy(MOVED * self.reach * random.standard_normal(3))
        zoom = math.exp(ZOOMED * (2 * random.random() - 1))
        viewmat = (step @ self.camera.viewmat.double()).to(self.camera.viewmat)
        if random.random() < self.backed:  # against the direction of view
            viewmat[2, 3] += self.reach * (FARTHER ** random.random() - 1)
        K = self.camera.K.clone()
        K[0, 0] *= zoom
        K[1, 1] *= zoom
        camera = replace(self.camera, viewmat=viewmat, K=K)
        return StoredView(camera, lambda: render(self.supervision, camera).pixels)


def only_pseudo(views: Sequence[View]) -> bool:
    """Whether there are no photographs."""
    return all(isinstance(view, PseudoView) for view in views)


@torch.no_grad()
def render_pseudo_views(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    progress: Listener | None = None,
) -> Scene:
    """A scene of ``cameras`` with the checkpoint's own renderings as photographs; every 8th is held
    out.

    Those to train on are rendered when they are read, and training renders each from a camera near
    it instead (``PseudoView.moved``); ``view.at(view.camera)`` stays where it is.

    Args:
        gaussians: the supervision, rendered at s = 1.
        progress: called in ``Phase.PSEUDO_VIEWS`` after each view that is held out.

    Example:
        >>> base = clod.load("base.ply")
        >>> cameras = clod.place_cameras(base.gaussians)
        >>> scene = clod.render_pseudo_views(base.gaussians, cameras)
    """
    supervision = gaussians.without_empty_bands()
    train = _views(supervision, cameras, backed=BACKED)
    test = list[View]()
    if len(cameras) > 1:
        held_out = train[::TEST_EVERY]
        del train[::TEST_EVERY]
        for view in held_out:
            test.append(View(view.camera, view.image))
            tell(progress, Phase.PSEUDO_VIEWS, len(test), len(held_out))
    size = f"{cameras[0].width}x{cameras[0].height}, {_field(cameras[0]):.0f} degrees wide"
    note = (
        f"no photographs: {len(train)} pseudo views to train on, {len(test)} held out, {size}; the"
        " checkpoint is the supervision, and all numbers compare with its renderings, not with"
        " photographs"
    )
    return Scene(tuple(train), tuple(test), (note,))


def with_pseudo_views(
    gaussians: Gaussians,
    scene: Scene | None,
    seed: int = 0,
    progress: Listener | None = None,
) -> Scene:
    """The scene with pseudo views beside few photographs, or, for None, of pseudo views at placed
    cameras alone.

    Args:
        progress: called in ``Phase.CAMERAS`` and ``Phase.PSEUDO_VIEWS``.
    """
    if scene is not None:
        return add_pseudo_views(gaussians, scene, seed, progress)
    cameras = place_cameras(gaussians, seed=seed, progress=progress)
    return render_pseudo_views(gaussians, cameras, progress=progress)


def add_pseudo_views(
    gaussians: Gaussians,
    scene: Scene,
    seed: int = 0,
    progress: Listener | None = None,
) -> Scene:
    """Adds ADDED pseudo views where there are few photographs, and repeats very few ones.

    They hold what the photographs do not show: fine-tuned on 33 photographs alone a checkpoint lost
    0.8 dB on others.

    Example:
        >>> base, scene = clod.load("base.ply"), clod.load_scene("scene")
        >>> more = clod.add_pseudo_views(base.gaussians, scene)
        >>> print(len(scene.train), len(more.train), more.notes)
    """
    photographs = scene.train
    if not 0 < len(photographs) < MANY:
        return scene
    nearby = max(min(MOST_NEARBY, ADDED // 2 // len(photographs)), 1)
    shortage = f"only {len(photographs)} photographs to train on"
    try:
        placed = place_cameras(
            gaussians,
            views=max(ADDED - nearby * len(photographs), ADDED // 2),
            seed=seed,
            field=_field(photographs[0].camera),
            progress=progress,
        )
    except ClodError as error:
        note = f"{shortage} may be too few, and no pseudo views can be added: {error}"
        return replace(scene, notes=(*scene.notes, note))
    supervision = gaussians.without_empty_bands()  # one for all: it may be a copy
    near = _views(supervision, [view.camera for view in photographs], wider=WIDER)
    pseudo_views = (*nearby * near, *_views(supervision, placed))
    times = f", and each photograph is used {nearby} times" if nearby > 1 else ""
    note = (
        f"{shortage}: {len(pseudo_views)} pseudo views, the checkpoint's own renderings, are"
        f" added{times}"
    )
    return replace(scene, train=(*nearby * photographs, *pseudo_views), notes=(*scene.notes, note))


def _views(
    supervision: Gaussians,
    cameras: Sequence[Camera],
    *,
    wider: float = 1.0,
    backed: float = 0.0,
) -> list[PseudoView]:
    pairs = zip(cameras, reaches(supervision, cameras), strict=True)
    return [PseudoView(camera, supervision, wider * reach, backed) for camera, reach in pairs]


def reaches(gaussians: Gaussians, cameras: Sequence[Camera]) -> list[float]:
    """Distance of each camera to the scene, world units: the median in its image, or over the
    cameras if less.

    A camera that looks past the scene has the background's.
    """
    sample = gaussians.means[:: len(gaussians) // SAMPLE + 1]
    medians = [median_distance(sample, camera) for camera in cameras]
    most = median(medians)
    return [min(distance, most) for distance in medians]


def supervision_to(views: Sequence[View], device: str) -> tuple[View, ...]:
    """The views with their supervision on ``device``: equal ones once, as a checkpoint is large."""
    pseudo_views = [view for view in views if isinstance(view, PseudoView)]
    checkpoints = {id(view.supervision): view.supervision for view in pseudo_views}
    on_device = {number: gaussians.to(device) for number, gaussians in checkpoints.items()}

    def moved(view: View) -> View:
        if not isinstance(view, PseudoView):
            return view
        gaussians = on_device[id(view.supervision)]
        return PseudoView(view.camera, gaussians, view.reach, view.backed)

    return tuple(map(moved, views))


def _field(camera: Camera) -> float:
    return math.degrees(2 * math.atan(0.5 * camera.width / float(camera.K[0, 0])))
