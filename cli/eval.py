"""``clod-adapt eval``: quality, count and time at some dial values, on the held-out photographs;
and comparisons.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clod_adapter import ClodError, Stopped
from clod_adapter._support.text import package_version
from clod_adapter.io.file_formats import file_has_dial
from clod_adapter.progress import GracefulStop

from .shared import command as common
from .shared.console import Console
from .shared.outputs import Outputs, Report, labels

if TYPE_CHECKING:
    from clod_adapter import Gaussians, Scene
    from clod_adapter.evaluation.evaluate import Row
    from clod_adapter.evaluation.popping import Popping

PRUNED = "the unadapted base, pruned to the same counts by two rankings"
MATCHED = "other files, each row followed by the dial value with the same count"
CLOSE = 0.01  # relative difference up to which two counts are equal
POPPING_VIEWS = 2  # held-out views in which the dial is turned
PATH_CAMERAS = 5  # neighbours by name, which are usually photographed one after the other


def add_arguments(parser: ArgumentParser) -> None:
    given = common.add_input(
        parser, "model", "MODEL.ply", "an adapted file, or a plain one as a baseline"
    )
    common.add_reading(given)
    dial = parser.add_argument_group("dial values, one of")
    default = (
        "dial values from 1 (full quality) (default: 1 2 3 5 below the largest trained, and that)"
    )
    common.add_dial_options(dial, default, "(mean over the held-out views)", several=True)
    measuring = parser.add_argument_group("measuring")
    measuring.add_argument(
        "--base", metavar="BASE.ply", help="also measure the checkpoint, pruned to each row's count"
    )
    text = "also measure other files, each beside MODEL.ply at the same number of Gaussians"
    measuring.add_argument("--against", metavar="FILE.ply", nargs="+", default=[], help=text)
    text = "also measure how evenly the image changes with the dial and the camera"
    measuring.add_argument("--popping", action="store_true", help=text)
    common.add_device(measuring, "render")
    output = parser.add_argument_group("output")
    output.add_argument(
        "--report", metavar="OUT.html", help="also write a self-contained page, and its charts"
    )


def paths(args: Namespace) -> list[str]:
    return [args.model, *args.against, *([args.base] if args.base else [])]


def check(args: Namespace) -> None:
    common.check_dials(args, args.model)
    labels(args.against)
    common.check_inputs(args.images, *paths(args))
    if args.base and file_has_dial(Path(args.base)):
        raise ClodError(
            f"{args.base}: has a dial; give --base the checkpoint before it, or use --against"
        )


def outputs(args: Namespace) -> Outputs:
    if not args.report:
        return Outputs()
    page, *charts = common.page_files(Path(args.report))
    return Outputs([page], charts, inputs=paths(args), scene=args.images)


def execute(args: Namespace) -> Report:
    from clod_adapter._support.machine import machine

    from .shared import measure as measuring
    from .shared.inputs import read_inputs
    from .shared.pages import add_page

    console, watch, stop = Console(args.quiet), measuring.Stopwatch(), GracefulStop()
    models, scene = read_inputs(args, paths(args), console, training=bool(args.base))
    model, *others = (each.gaussians for each in models)
    base = others.pop() if args.base else None
    given = measuring.solve_dials(args, models[0], [view.camera for view in scene.test], console)
    dials = measuring.choose_dials(given, models[0], console)
    compared: Report = {"base_row": None, "ranked": [], "against": [], "popping": []}
    comparisons = Comparisons(model, scene, console, stop, compared)
    with stop.listening():
        rows = measuring.measure(model, scene.test, dials, console, stop)
        if not rows:
            raise Stopped("stopped before the first row")
        (rows,) = measuring.comparable([(model, rows)], scene.test, console, stop)
        print(measuring.table(measuring.by_dial(rows)))
        with suppress(Stopped):
            if base is not None:
                comparisons.prune(base, rows)
            if others:
                comparisons.match(dict(zip(args.against, others, strict=True)), rows)
            if args.popping:
                comparisons.pop(max(row.virtual_scale for row in rows))
    print(comparisons.text(), end="")
    report: Report = {  # the page has the first two as well
        "command": "eval",
        "version": package_version(),
        "model": args.model,
        "scene": args.images,
        "base_count": model.whole,
        "sh_degree": model.sh_degree,
        "views": len(scene.test),
        "rows": [row.as_dict() for row in rows],
        "base": args.base,
        **compared,
        "interrupted": stop.requests > 0,
        "attenuation": asdict(model.attenuation) if model.attenuation else None,
        "notes": console.notes,
        "machine": machine(),
        "device": str(model.means.device),
        "seconds": watch.report(),
    }
    if args.report:
        try:
            add_page(Path(args.report), report, model, base, scene, console)
        except ClodError as error:  # the rows are measured, and printed
            print(f"clod-adapt: error: {error}", file=sys.stderr)
            report |= {"error": str(error), "exit_code": 2}
    return report


@dataclass
class Comparisons:
    """Comparisons of a model; those that are finished, in ``report`` for --json and as text."""

    model: Gaussians
    scene: Scene
    console: Console
    stop: GracefulStop
    report: Report
    tables: dict[str, list[tuple[str, Row]]] = field(default_factory=dict)

    def prune(self, base: Gaussians, rows: Sequence[Row]) -> None:
        """Measures the base with all its Gaussians, and pruned by two rankings to the counts of
        ``rows``.
        """
        from clod_adapter.cameras import spread
        from clod_adapter.initialization.importance import MOST_VIEWS, removal_error

        with self.console.meter("removal error") as meter:
            cameras = [view.camera for view in spread(self.scene.train, MOST_VIEWS)]
            removal = removal_error(base, cameras, progress=self.stop.stop_on_signal(meter))
        values = {"opacity": base.opacity_logits, "removal error": removal}
        orders = {by: each.argsort(descending=True, stable=True) for by, each in values.items()}
        whole = self._row(base, 1.0, "base")
        table = self.tables[PRUNED] = [("base", whole)]
        self.report["base_row"] = whole.as_dict()
        for ours in rows:
            dial = ours.virtual_scale
            table.append((f"s={dial:g}", ours))
            for by, order in orders.items():
                pruned = base.select(order[: round(ours.kept)])
                row = self._row(pruned, 1.0, f"base by {by}")
                row = replace(row, kept_share=row.kept / len(base))  # of the whole base
                table.append((by, row))
                self.report["ranked"].append(
                    {"virtual_scale": dial, "by": by, "row": row.as_dict()}
                )

    def match(self, others: Mapping[str, Gaussians], rows: Sequence[Row]) -> None:
        """Measures files at the dial values of ``rows``, and the model at the same counts."""
        from clod_adapter.evaluation.budget import matching_dial, mean_kept

        cameras = [view.camera for view in self.scene.test]
        dials = [row.virtual_scale for row in rows]
        for (path, other), label in zip(others.items(), labels(list(others)), strict=True):
            for s in dials if other.sigma_d is not None else [1.0]:
                count = mean_kept(other, cameras, s)
                same = matching_dial(self.model, cameras, count)
                kept = mean_kept(self.model, cameras, same)
                if abs(kept - count) > CLOSE * count:
                    self.console.note(
                        f"{path} keeps {count:,.0f} Gaussians; the model is compared with"
                        f" {'at most' if kept < count else 'at least'} {kept:,.0f}"
                    )
                theirs = self._row(other, s, label)
                ours = self._row(self.model, same, "model")
                self.tables.setdefault(MATCHED, []).extend(
                    [(label, theirs), (f"s={same:.4g}", ours)]
                )
                pair = {"theirs": theirs.as_dict(), "ours": ours.as_dict()}
                self.report["against"].append({"model": path, "label": label, **pair})

    def pop(self, max_sv: float) -> None:
        from clod_adapter.evaluation.popping import dial_popping, path_popping

        if self.model.sigma_d is None or max_sv <= 1:
            self.console.note(
                "popping is not measured: there is no dial, or only s = 1 was requested"
            )
            return
        test = [view.camera for view in self.scene.test]
        sweeps: list[tuple[str, Callable[..., Popping], Any]] = []
        for k in range(min(POPPING_VIEWS, len(test))):
            camera = test[(2 * k + 1) * len(test) // (2 * POPPING_VIEWS)]
            sweeps.append((f"dial, {camera.name}", dial_popping, camera))
        cameras = [*test, *(view.camera for view in self.scene.train)]
        ordered = sorted(cameras, key=lambda camera: camera.name)
        # the middle of the capture
        walk = ordered[max((len(ordered) - PATH_CAMERAS) // 2, 0) :][:PATH_CAMERAS]
        if len(walk) > 1:
            moved = f"camera, {walk[0].name} to {walk[-1].name}, s = {max_sv:g}"
            sweeps.append((moved, path_popping, walk))
        for moved, popping, place in sweeps:
            with self.console.meter("popping") as meter:
                listener = self.stop.stop_on_signal(meter)
                result = popping(self.model, place, max_sv, progress=listener)
            self.report["popping"].append({"moved": moved, **vars(result)})

    def _row(self, gaussians: Gaussians, virtual_scale: float, label: str) -> Row:
        from .shared.measure import measure

        rows = measure(gaussians, self.scene.test, [virtual_scale], self.console, self.stop, label)
        if not rows:
            raise Stopped("stopped within a comparison")
        return rows[0]

    def text(self) -> str:
        """The tables for the console; empty without comparisons."""
        from .shared.measure import popping_table, table

        parts = [f"{title}:\n{table(rows)}" for title, rows in self.tables.items()]
        if self.report["popping"]:
            parts.append(popping_table(self.report["popping"]))
        return "".join(f"\n{part}\n" for part in parts)


DESCRIPTION = "Measure quality, Gaussians kept and frame time at several dial values."
USAGE = "MODEL.ply --images DIR [--sv S [S ...]] [options]"
EPILOG = f"""\
{common.BUDGETS}
columns, over the held-out photographs (every 8th by name):
  PSNR, SSIM  means against the photographs
  kept        Gaussians kept, and their share of all
  in view     of these, the ones with their centre in the image
  frame ms    median time to render an image

--base adds two rows per dial value: the base without tuning, reduced to as many
Gaussians by opacity, and by removal error (the error in the training views when
one Gaussian is removed). --against measures a file with a dial at every dial
value, and MODEL.ply at as many Gaussians, or at s = 1.

--popping turns the dial from 1 to the largest S in 200 equal ratios at two
held-out cameras, and moves through five cameras in 200 steps at that S.

Ctrl-C skips unfinished dial values (exit code 0, "interrupted": true; 130 if
none is finished).

examples:
  clod-adapt eval garden_clod.ply --images garden
  clod-adapt eval garden_clod.ply --images garden --base garden.ply --popping
  clod-adapt eval garden_clod.ply --images garden --against merged.ply cut.ply
  clod-adapt eval garden_clod.ply --images garden --keep 500000 200000
"""
