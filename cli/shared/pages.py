"""``--report``: renders the images of a run's page; its rows are those of the report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch

from clod_adapter import (
    AdaptConfig,
    ClodError,
    Gaussians,
    Phase,
    Progress,
    Scene,
    Stopped,
    View,
    evaluate,
    render,
)
from clod_adapter.losses import psnr
from clod_adapter.report.page import Picture, from_checkpoint, write_page

from .console import Console
from .outputs import Report, jsonable
from .process import interrupt_as_stopped

FRAMES = 13  # positions of the page's slider
# shares of the training at which the result so far is copied
SNAPSHOTS = tuple(2.0**-k for k in range(6, 0, -1))
SNAPSHOT_VIEWS = 12  # held-out views that snapshots are measured on, at most


def add_page(
    path: Path,
    report: Report,
    model: Gaussians,
    base: Gaussians | None,
    scene: Scene,
    console: Console,
    training: Callable[[], Report | None] = lambda: None,
) -> None:
    """Writes the page and adds its files to the report, unless Ctrl-C stops it, which a note
    says.
    """
    try:
        with interrupt_as_stopped():
            curves = training()
            with console.status(f"writing {path} ..."):
                frames, others = pictures(model, base, scene.test, from_checkpoint(report))
                written = write_page(path, jsonable(report), frames, others, jsonable(curves))
    except Stopped:
        console.note("the page was interrupted and not written")
    else:
        console.say(f"wrote {path}: open it in a browser")
        report["outputs"] = report.get("outputs", {}) | written


@dataclass
class AdaptPage:
    """Copies the result so far during training, and measures the copies after its end, for the
    page.
    """

    base: Gaussians
    scene: Scene
    config: AdaptConfig
    console: Console
    due: tuple[float, ...] = (0.0, *SNAPSHOTS)
    # seconds of the training, and the state then
    snapshots: list[tuple[float, Gaussians]] = field(default_factory=list)
    trained = 0.0

    def __call__(self, now: Progress, whole: Callable[[Gaussians], Gaussians]) -> None:
        """Listens; ``whole`` is given the Gaussians that are trained, and returns all."""
        if now.phase == Phase.TRAINING and now.gaussians is not None:
            self.trained = now.seconds
            if self.due and now.share >= self.due[0]:
                self.due = tuple(share for share in self.due if share > now.share)
                state = whole(now.gaussians())
                # The largest, if it is not trained; far Gaussians have their own.
                copied = {name: value.clone() for name, value in state.tensors().items()}
                if len(state) == len(self.base) and self.config.lr_shN == 0:
                    copied["shN"] = self.base.shN
                self.snapshots.append((now.seconds, state.replace(**copied)))

    def write(self, path: Path, report: Report, result: Gaussians, start_seconds: float) -> None:
        """The same of a run, whose other files are written: the disk stops the page alone, which a
        note says.
        """
        training = partial(self._training, result, start_seconds)
        try:
            add_page(path, report, result, self.base, self.scene, self.console, training)
        except ClodError as error:
            self.console.note(f"the page was not written: {error}")

    def _training(self, result: Gaussians, start_seconds: float) -> Report | None:
        """Held-out PSNR of the copies and of the result, at s = 1, 3 and the largest."""
        if not (self.scene.test and self.snapshots):
            return None
        views = self.scene.test[:: -(-len(self.scene.test) // SNAPSHOT_VIEWS)]
        dials = sorted({1.0, min(3.0, self.config.max_sv), self.config.max_sv})
        if self.snapshots[-1][0] == self.trained:  # the result itself
            self.snapshots.pop()
        states = [*self.snapshots, (self.trained, result)]
        curves: list[Report] = [
            {"label": f"s = {s:g}", "virtual_scale": s, "points": []} for s in dials
        ]
        with self.console.meter("snapshots") as meter:
            for k, (seconds, state) in enumerate(states):
                for curve, row in zip(curves, evaluate(state, views, dials), strict=True):
                    curve["points"].append({"seconds": start_seconds + seconds, **row.as_dict()})
                meter.update((k + 1) / len(states), f"{k + 1}/{len(states)}")
        (base,) = evaluate(self.base, views, [1.0])
        return {"views": len(views), "base_psnr": base.psnr, "curves": curves}


@torch.no_grad()
def pictures(
    model: Gaussians, base: Gaussians | None, views: Sequence[View], own: bool = False
) -> tuple[list[Picture], dict[str, Picture]]:
    """The middle held-out view at the dial values of the slider, and what to compare it with."""
    if not views:
        return [], {}
    view = views[len(views) // 2]
    pixels = view.image.numpy()
    if own:
        detail = "its own rendering, the reference"
        others = {"base": Picture(pixels, "base, unadapted", detail)}
    else:
        others = {"photograph": Picture(pixels, "photograph", "held out from training")}
        if base is not None:
            others["base"] = _rendered(base, view, 1.0, "base, unadapted")
    widest = model.attenuation.max_sv if model.attenuation else 1.0
    dials = dict.fromkeys(float(f"{widest ** (k / (FRAMES - 1)):.2g}") for k in range(FRAMES))
    title = "s = {:g}" if model.sigma_d is not None else "the file"
    return [_rendered(model, view, s, title.format(s)) for s in dials], others


def _rendered(gaussians: Gaussians, view: View, virtual_scale: float, title: str) -> Picture:
    rendering = render(gaussians, view.camera, virtual_scale)
    kept, error = int(rendering.kept.sum()), psnr(rendering.image, view.image)
    detail = (
        f"{error:.2f} dB on this view, {kept:,} Gaussians ({kept / max(gaussians.whole, 1):.0%})"
    )
    return Picture(rendering.pixels.cpu().numpy(), title, detail)
