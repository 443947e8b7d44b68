"""What ``clod-adapt eval`` measures on request: comparison rows and popping. The computing is in the library."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from torch import Tensor

from clod_adapter.cameras import Scene, View
from clod_adapter.evaluation.baselines import matching_dial, mean_kept, rankings
from clod_adapter.evaluation.evaluate import Row, evaluate
from clod_adapter.evaluation.perceptual import Metric
from clod_adapter.evaluation.popping import Popping, dial_popping, path_popping
from clod_adapter.gaussians import Gaussians

from .shared.console import Console
from .shared.files import labels
from .shared.report import popping_table, rows_table

CLOSE = 0.01  # relative distance of two counts that count as the same
POPPING_VIEWS = 2  # held-out views before which the dial is turned
PATH_CAMERAS = 5  # neighbours by name, which a capture takes one after the other

Job = tuple[str, Gaussians, Tensor | None, float]
"""A label, Gaussians, which of them (None for all), and the dial value."""


@dataclass
class Comparisons:
    """Runs what was asked for; what is finished when Ctrl-C ends it is kept.

    Attributes:
        base_row: the base as it is.
        ranked: (our dial value, ranked by, the base at as many Gaussians as that keeps).
        against: (file, that file, ours at the dial value that keeps as many).
        popping: (what moved, how the picture changed).
    """

    model: Gaussians
    scene: Scene
    metrics: Mapping[str, Metric]
    console: Console
    base_row: Row | None = None
    ranked: list[tuple[Row, str, Row]] = field(default_factory=list)
    against: list[tuple[str, Row, Row]] = field(default_factory=list)
    popping: list[tuple[str, Popping]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def run(
        self, rows: Sequence[Row], base: Gaussians | None, others: Mapping[str, Gaussians], with_popping: bool
    ) -> bool:
        """Returns whether Ctrl-C cut it short.

        Args:
            rows: of the model, at whose counts the base is ranked; a file with a dial is measured at their values.
        """
        try:
            if base is not None:
                self._rank(rows, base)
            if others:
                self._match(rows, others)
            if with_popping:
                self._pop(max(row.virtual_scale for row in rows))
        except KeyboardInterrupt:
            return True
        return False

    def report(self) -> dict[str, Any]:
        """For --json."""
        paths = list(dict.fromkeys(path for path, *_ in self.against))
        names = dict(zip(paths, labels(paths), strict=True))
        return {
            "base_row": self.base_row.as_dict() if self.base_row else None,
            "ranked": [
                {"virtual_scale": ours.virtual_scale, "by": by, "row": row.as_dict()} for ours, by, row in self.ranked
            ],
            "against": [
                {"model": path, "label": names[path], "theirs": theirs.as_dict(), "ours": ours.as_dict()}
                for path, theirs, ours in self.against
            ],
            "popping": [{"moved": moved, **result.as_dict()} for moved, result in self.popping],
        }

    def text(self) -> str:
        """For the console; nothing where nothing was asked for."""
        parts = []
        if self.base_row:
            marked = [("base", self.base_row)]
            for ours, by, row in self.ranked:
                label = f"s={ours.virtual_scale:g}"
                marked += [(label, ours)] if (label, ours) not in marked else []
                marked.append((by, row))
            title = "beside the base, neither adapted nor faded, cut to the same counts by rank:"
            parts.append(f"{title}\n{rows_table(marked)}")
        if self.against:
            marked = []
            for path, theirs, ours in self.against:
                marked += [(path, theirs), (f"s={ours.virtual_scale:.4g}", ours)]
            parts.append(f"other files, and below each the dial value that keeps as many:\n{rows_table(marked)}")
        if self.popping:
            parts.append(popping_table(self.popping))
        return "".join(f"\n{part}\n" for part in parts)

    def _rank(self, rows: Sequence[Row], base: Gaussians) -> None:
        with self.console.meter("removal error") as meter:
            orders = rankings(base, self.scene.train, lambda done, total: meter.update(done / total, f"{done}/{total}"))
        wanted = [(row, by, order) for row in rows for by, order in orders.items()]
        jobs: list[Job] = [("base", base, None, 1.0)]
        jobs += [(by, base, order[: round(row.kept)], 1.0) for row, by, order in wanted]
        found = self._measured(jobs)
        self.base_row = next(found)
        for (ours, by, _), row in zip(wanted, found, strict=True):
            self.ranked.append((ours, by, replace(row, kept_share=row.kept / len(base))))  # not of what was selected

    def _match(self, rows: Sequence[Row], others: Mapping[str, Gaussians]) -> None:
        cameras = [view.camera for view in self.scene.test]
        jobs: list[Job] = []
        with self.console.status("looking for the dial values that keep as many ..."):
            for path, other in others.items():
                for theirs in [row.virtual_scale for row in rows] if other.sigma_d is not None else [1.0]:
                    count = mean_kept(other, cameras, theirs)
                    ours = matching_dial(self.model, cameras, count)
                    jobs += [(path, other, None, theirs), (path, self.model, None, ours)]
                    self._note_count(path, count, mean_kept(self.model, cameras, ours))
        found = self._measured(jobs)
        for (path, *_), their_row, our_row in zip(jobs[::2], found, found, strict=True):
            self.against.append((path, their_row, our_row))

    def _note_count(self, path: str, count: float, kept: float) -> None:
        if abs(kept - count) > CLOSE * count:
            more = "at most" if kept < count else "at least"
            self.notes.append(f"{path} keeps {count:,.0f} Gaussians; beside it is the model with {more} {kept:,.0f}")
            self.console.say(self.notes[-1])

    def _measured(self, jobs: Sequence[Job]) -> Iterator[Row]:
        """The jobs' rows, one by one, under one progress bar."""
        with self.console.meter("compare") as meter:
            for i, (label, gaussians, chosen, virtual_scale) in enumerate(jobs):
                shown = gaussians if chosen is None else gaussians.select(chosen)

                def update(done: int, total: int, before: int = i, label: str = label) -> None:
                    meter.update((before + done / total) / len(jobs), label)

                yield evaluate(shown, self.scene.test, [virtual_scale], metrics=self.metrics, progress=update)[0]

    def _pop(self, max_sv: float) -> None:
        if self.model.sigma_d is None or max_sv <= 1:
            self.notes.append("no popping is measured: there is no dial to turn, or only s = 1 was asked for")
            self.console.say(self.notes[-1])
            return
        test = self.scene.test
        views = [test[(2 * k + 1) * len(test) // (2 * POPPING_VIEWS)] for k in range(min(POPPING_VIEWS, len(test)))]
        walk = _neighbours([*self.scene.train, *test])
        jobs = [(f"dial, {v.camera.name}", partial(dial_popping, self.model, v.camera, max_sv)) for v in views]
        if len(walk) > 1:
            path = partial(path_popping, self.model, [view.camera for view in walk], max_sv)
            jobs.append((f"camera, {walk[0].camera.name} to {walk[-1].camera.name}, s = {max_sv:g}", path))
        with self.console.meter("popping") as meter:
            for i, (moved, measure) in enumerate(jobs):

                def update(done: int, total: int, before: int = i, moved: str = moved) -> None:
                    meter.update((before + done / total) / len(jobs), moved)

                self.popping.append((moved, measure(progress=update)))


def _neighbours(views: Sequence[View]) -> list[View]:
    """PATH_CAMERAS from the middle of the capture, in the order of their names."""
    ordered = sorted(views, key=lambda view: view.camera.name)
    first = max((len(ordered) - PATH_CAMERAS) // 2, 0)
    return ordered[first : first + PATH_CAMERAS]
