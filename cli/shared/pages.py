"""``--report``: a run's page. Its pictures are rendered here; its rows are those of the report."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from clod_adapter.cameras import Scene, View
from clod_adapter.config import AdaptConfig
from clod_adapter.errors import ClodError
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.lock import output_lock
from clod_adapter.metrics import psnr
from clod_adapter.render import render
from clod_adapter.report.page import Picture
from clod_adapter.report.tradeoff_page import own_teacher, write_tradeoff_report
from clod_adapter.training.loop import Progress

from .console import Console
from .report import jsonable

FRAMES = 13  # positions of the page's slider
SNAPSHOTS = tuple(2.0**-k for k in range(6, 0, -1))  # shares of the training at which its state is copied
INTERRUPTED = "the page was interrupted and not written"
SNAPSHOT_VIEWS = 12  # held-out views that these are measured on, at most


def write_eval_page(
    args: argparse.Namespace,
    report: dict[str, Any],
    model: Gaussians,
    base: Gaussians | None,
    scene: Scene,
    console: Console,
) -> dict[str, Any]:
    """The page where ``--report`` asks for it, with a picture of the base where there is one; adds to the report."""
    if not args.report:
        return {}
    return {"outputs": _write(Path(args.report), report, model, base, scene, console)}


class AdaptPage:
    """Follows a training for its page: copies the state now and then, and measures the copies after the end."""

    def __init__(self, base: Gaussians, scene: Scene, config: AdaptConfig, console: Console) -> None:
        self.base, self.scene, self.config, self.console = base, scene, config, console
        self.due = [0.0, *SNAPSHOTS]
        self.snapshots: list[tuple[float, Gaussians]] = []  # seconds of the training, and the state then
        self.trained = 0.0

    def watching(self, follow: Callable[[Progress], None]) -> Callable[[Progress], None]:
        """The progress callback that also takes the copies."""

        def call(progress: Progress) -> None:
            if progress.phase == "train":
                self.trained = progress.seconds
                if self.due and progress.share >= self.due[0]:
                    self.due = [share for share in self.due if share > progress.share]
                    self.snapshots.append((progress.seconds, self._copy(progress.gaussians())))
            follow(progress)

        return call

    def _copy(self, state: Gaussians) -> Gaussians:
        fixed = {"shN": self.base.shN} if self.config.lr_shN == 0 else {}  # the largest part, where it is not trained
        changing = {name: value.clone() for name, value in state.tensors().items() if name not in fixed}
        return state.replace(**changing, **fixed)

    def write(self, path: Path, report: dict[str, Any], result: Gaussians, start_seconds: float) -> dict[str, str]:
        """Writes the page; returns its files, none, and a note in the report, where Ctrl-C or the disk stopped it."""
        try:
            training = self._training(result, start_seconds) if self.scene.test and self.snapshots else None
        except KeyboardInterrupt:
            return _without(report, self.console, INTERRUPTED)
        return _write(path, report, result, self.base, self.scene, self.console, training)

    def _training(self, result: Gaussians, start_seconds: float) -> dict[str, Any]:
        """Held-out PSNR of the copies and of the result, at s = 1, 3 and the largest."""
        views = self.scene.test[:: -(-len(self.scene.test) // SNAPSHOT_VIEWS)]
        dials = sorted({1.0, min(3.0, self.config.max_sv), self.config.max_sv})
        if self.snapshots[-1][0] == self.trained:  # the state at the end, which is the result
            self.snapshots.pop()
        states = [*self.snapshots, (self.trained, result)]
        curves: list[dict[str, Any]] = [{"label": f"s = {s:g}", "virtual_scale": s, "points": []} for s in dials]
        with self.console.meter("snapshots") as meter:
            for k, (seconds, state) in enumerate(states):
                for curve, row in zip(curves, evaluate(state, views, dials), strict=True):
                    curve["points"].append({"seconds": start_seconds + seconds, **row.as_dict()})
                meter.update((k + 1) / len(states), f"{k + 1}/{len(states)}")
        (base,) = evaluate(self.base, views, [1.0])
        return {"views": len(views), "base_psnr": base.psnr, "curves": curves}


def _write(
    path: Path,
    report: dict[str, Any],
    model: Gaussians,
    base: Gaussians | None,
    scene: Scene,
    console: Console,
    training: dict[str, Any] | None = None,
) -> dict[str, str]:
    try:
        with output_lock(path), console.status(f"writing {path} ..."):
            frames, others = pictures(model, base, scene.test, own_teacher(report))
            written = write_tradeoff_report(path, jsonable(report), frames, others, jsonable(training))
    except KeyboardInterrupt:
        return _without(report, console, INTERRUPTED)
    except ClodError as error:
        return _without(report, console, f"there is no page: {error}")
    console.say(f"wrote {path}: open it in a browser")
    return {name: str(file) for name, file in written.items()}


def _without(report: dict[str, Any], console: Console, why: str) -> dict[str, str]:
    """No files, and a note: what was measured is worth reporting without its page."""
    report["notes"].append(why)
    console.say(why)
    return {}


@torch.no_grad()
def pictures(
    model: Gaussians, base: Gaussians | None, views: Sequence[View], own: bool = False
) -> tuple[list[Picture], dict[str, Picture]]:
    """The held-out view in the middle over the dial; and the photograph, and the base.

    Args:
        own: the views are not photographs but the base's own pictures.
    """
    if not views:
        return [], {}
    view = views[len(views) // 2]
    if own:
        others = {"base": Picture(view.image.numpy(), "base, unadapted", "its own picture, which errors are against")}
    else:
        others = {"photograph": Picture(view.image.numpy(), "photograph", "held out from training")}
        others |= {"base": _rendered(base, view, 1.0, "base, unadapted")} if base is not None else {}
    widest = model.attenuation.max_sv if model.attenuation else 1.0
    dials = dict.fromkeys(float(f"{widest ** (k / (FRAMES - 1)):.2g}") for k in range(FRAMES))
    title = "s = {:g}" if model.sigma_d is not None else "the file"
    return [_rendered(model, view, s, title.format(s)) for s in dials], others


def _rendered(gaussians: Gaussians, view: View, virtual_scale: float, title: str) -> Picture:
    rendering = render(gaussians, view.camera, virtual_scale)
    kept, error = int(rendering.kept.sum()), psnr(rendering.image, view.image)
    detail = f"{error:.2f} dB on this view, {kept:,} Gaussians ({kept / max(len(gaussians), 1):.0%})"
    return Picture(rendering.image.cpu().numpy(), title, detail)
