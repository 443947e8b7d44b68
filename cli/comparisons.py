"""Optional comparisons of ``clod-adapt eval``: the base and other files at equal counts, and popping."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor

from clod_adapter.cameras import Scene, View
from clod_adapter.evaluation.baselines import matching_dial, mean_kept, rankings
from clod_adapter.evaluation.evaluate import Row, evaluate
from clod_adapter.evaluation.perceptual import Metric
from clod_adapter.evaluation.popping import Popping, dial_popping, path_popping
from clod_adapter.gaussians import Gaussians
from clod_adapter.progress import Stopped

from .shared.console import Console
from .shared.measure import popping_table, rows_table
from .shared.outputs import labels
from .shared.process import GracefulStop

CLOSE = 0.01  # relative difference up to which two counts are equal
POPPING_VIEWS = 2  # held-out views in which the dial is turned
PATH_CAMERAS = 5  # neighbours by name, which are usually photographed one after the other

Job = tuple[str, Gaussians, Tensor | None, float]
"""A label, Gaussians, the rows of them that are measured (None for all), and the dial value."""


@dataclass(frozen=True)
class Comparisons:
    """The comparisons that were finished.

    Attributes:
        base_row: the unadapted base with all its Gaussians.
        ranked: (row of the model, ranking, the base pruned by that ranking to the same count).
        against: (file, its row, row of the model at the dial value with the same count).
        popping: (what moves, how the image changes).
        interrupted: Ctrl-C ended them early.
    """

    base_row: Row | None = None
    ranked: tuple[tuple[Row, str, Row], ...] = ()
    against: tuple[tuple[str, Row, Row], ...] = ()
    popping: tuple[tuple[str, Popping], ...] = ()
    notes: tuple[str, ...] = ()
    interrupted: bool = False

    def _others(self) -> list[str]:
        return list(dict.fromkeys(path for path, *_ in self.against))

    def _table_against(self, path: str) -> str:
        marked = list[tuple[str, Row]]()
        for other, theirs, ours in self.against:
            marked += [("theirs", theirs), (f"s={ours.virtual_scale:.4g}", ours)] if other == path else []
        return f"{path}\n{rows_table(marked)}"

    def report(self) -> dict[str, Any]:
        """For --json."""
        paths = self._others()
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
        """For the console; empty without comparisons."""
        parts = []
        if self.base_row:
            marked = [("base", self.base_row)]
            for ours, by, row in self.ranked:
                label = f"s={ours.virtual_scale:g}"
                marked += [(label, ours)] if (label, ours) not in marked else []
                marked.append((by, row))
            title = "the unadapted base, pruned to the same counts by two rankings:"
            parts.append(f"{title}\n{rows_table(marked)}")
        if self.against:
            title = "other files, each row followed by the dial value with the same count:"
            parts.append("\n".join([title, *(self._table_against(path) for path in self._others())]))
        if self.popping:
            parts.append(popping_table(self.popping))
        return "".join(f"\n{part}\n" for part in parts)


def compare(
    model: Gaussians, rows: Sequence[Row], base: Gaussians | None, others: Mapping[str, Gaussians], scene: Scene,
    metrics: Mapping[str, Metric], console: Console, with_popping: bool,
) -> Comparisons:  # fmt: skip
    """Measures the requested comparisons; after Ctrl-C, returns the finished ones.

    Args:
        rows: of the model: the base is pruned to their counts, and other files with a dial are measured at their
            dial values.
    """
    stop, found = GracefulStop(), Comparisons()
    run = _Comparing(model, scene, metrics, console, stop)
    with stop.listening():
        try:
            for base_row, ranked in run.ranked(rows, base) if base is not None else ():
                found = replace(found, base_row=base_row, ranked=(*found.ranked, *ranked))
            for notes, against in run.against(rows, others) if others else ():
                found = replace(found, notes=(*found.notes, *notes), against=(*found.against, *against))
            for notes, popping in run.popping(max(row.virtual_scale for row in rows)) if with_popping else ():
                found = replace(found, notes=(*found.notes, *notes), popping=(*found.popping, *popping))
        except Stopped:
            return replace(found, interrupted=True)
    return found


@dataclass(frozen=True)
class _Comparing:
    """The measurements; each yields its results one by one."""

    model: Gaussians
    scene: Scene
    metrics: Mapping[str, Metric]
    console: Console
    stop: GracefulStop

    def ranked(self, rows: Sequence[Row], base: Gaussians) -> Iterator[tuple[Row, list[tuple[Row, str, Row]]]]:
        with self.console.meter("removal error") as meter:
            orders = rankings(base, self.scene.train, self.stop.heeding(meter))
        wanted = [(row, by, order) for row in rows for by, order in orders.items()]
        jobs: list[Job] = [("base", base, None, 1.0)]
        jobs += [(by, base, order[: round(row.kept)], 1.0) for row, by, order in wanted]
        found = self._measured(jobs)
        base_row = next(found)
        yield base_row, []
        for (ours, by, _), row in zip(wanted, found, strict=True):
            yield base_row, [(ours, by, replace(row, kept_share=row.kept / len(base)))]  # of the whole base

    def against(
        self, rows: Sequence[Row], others: Mapping[str, Gaussians]
    ) -> Iterator[tuple[list[str], list[tuple[str, Row, Row]]]]:
        cameras = [view.camera for view in self.scene.test]
        jobs, notes = list[Job](), list[str]()
        with self.console.status("finding the dial values with the same counts ..."):
            for path, other in others.items():
                for theirs in [row.virtual_scale for row in rows] if other.sigma_d is not None else [1.0]:
                    count = mean_kept(other, cameras, theirs)
                    ours = matching_dial(self.model, cameras, count)
                    jobs += [(path, other, None, theirs), (path, self.model, None, ours)]
                    notes += self._count_note(path, count, mean_kept(self.model, cameras, ours))
        yield notes, []
        found = self._measured(jobs)
        for (path, *_), their_row, our_row in zip(jobs[::2], found, found, strict=True):
            yield [], [(path, their_row, our_row)]

    def popping(self, max_sv: float) -> Iterator[tuple[list[str], list[tuple[str, Popping]]]]:
        if self.model.sigma_d is None or max_sv <= 1:
            yield [self._noted("popping is not measured: there is no dial, or only s = 1 was requested")], []
            return
        test, walk = self.scene.test, _neighbours([*self.scene.train, *self.scene.test])
        views = [test[(2 * k + 1) * len(test) // (2 * POPPING_VIEWS)] for k in range(min(POPPING_VIEWS, len(test)))]
        jobs: list[tuple[str, Callable[..., Popping]]] = [
            (f"dial, {v.camera.name}", partial(dial_popping, self.model, v.camera, max_sv)) for v in views
        ]
        if len(walk) > 1:
            path = partial(path_popping, self.model, [view.camera for view in walk], max_sv)
            jobs.append((f"camera, {walk[0].camera.name} to {walk[-1].camera.name}, s = {max_sv:g}", path))
        with self.console.meter("popping") as meter:
            for i, (moved, sweep) in enumerate(jobs):
                yield [], [(moved, sweep(progress=self.stop.heeding(meter.part(i, len(jobs), moved))))]

    def _measured(self, jobs: Sequence[Job]) -> Iterator[Row]:
        with self.console.meter("compare") as meter:
            for i, (label, gaussians, chosen, virtual_scale) in enumerate(jobs):
                shown = gaussians if chosen is None else gaussians.select(chosen)
                listener = self.stop.heeding(meter.part(i, len(jobs), label))
                rows = evaluate(shown, self.scene.test, [virtual_scale], metrics=self.metrics, progress=listener)
                if not rows:
                    raise Stopped(f"stopped at {label}")
                yield rows[0]

    def _count_note(self, path: str, count: float, kept: float) -> list[str]:
        if abs(kept - count) <= CLOSE * count:
            return []
        more = "at most" if kept < count else "at least"
        return [self._noted(f"{path} keeps {count:,.0f} Gaussians; the model is compared with {more} {kept:,.0f}")]

    def _noted(self, text: str) -> str:
        self.console.say(text)
        return text


def _neighbours(views: Sequence[View]) -> list[View]:
    """PATH_CAMERAS from the middle of the capture, in the order of their names."""
    ordered = sorted(views, key=lambda view: view.camera.name)
    first = max((len(ordered) - PATH_CAMERAS) // 2, 0)
    return ordered[first : first + PATH_CAMERAS]
