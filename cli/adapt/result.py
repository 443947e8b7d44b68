"""The result of training: the adapter, the adapted Gaussians, and their measurements."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from clod_adapter.adapter import Adapter, detach, extract, trim
from clod_adapter.evaluation.evaluate import Row
from clod_adapter.gaussians import Gaussians
from clod_adapter.io.checkpoint import Checkpoint, trimmed
from clod_adapter.training.plan import Plan
from clod_adapter.training.state import Adapted

from ..shared.measure import measure, report_dials, with_frame_times
from ..shared.process import GracefulStop, listen_no_more
from .inputs import Inputs
from .processes import explain, hurried
from .setup import Setup


@dataclass(frozen=True)
class Result:
    """What is written.

    Attributes:
        base: the checkpoint with the rows and SH degrees that are written; with ``--trim`` not all of them.
        gaussians: ``adapter`` applied to ``base``.
        notes: for the report.
    """

    plan: Plan
    adapted: Adapted
    base: Checkpoint
    adapter: Adapter
    gaussians: Gaussians
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Measurements:
    """The rows of the base; of the result over the dial, and without it, as a viewer shows it that does not know it."""

    base: tuple[Row, ...] = ()
    rows: tuple[Row, ...] = ()
    plain: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()
    interrupted: bool = False


def make_result(setup: Setup, inputs: Inputs, plan: Plan, adapted: Adapted) -> Result:
    """Extracts the adapter, and applies it to the base."""
    if hurried(adapted):
        listen_no_more()
    gaussians, kept, degree = inputs.base.gaussians, None, None
    if setup.args.trim and plan.trims(gaussians):
        kept, degree = plan.kept, plan.sh_degree
    base = trimmed(inputs.base, kept, degree)
    adapter = extract(
        trim(gaussians, kept, degree), trim(adapted.gaussians, kept, degree), fingerprint=base.fingerprint,
        config=asdict(inputs.config), origin=base.origin,
    )  # fmt: skip
    adapter = replace(adapter, kept=kept, sh_degree=degree)
    notes = training_notes(inputs, adapter, adapted)
    for note in notes:
        setup.console.say(note)
    return Result(plan, adapted, base, adapter, adapter.apply(gaussians), tuple(notes))


def training_notes(inputs: Inputs, adapter: Adapter, adapted: Adapted) -> list[str]:
    notes, tau = list[str](), adapter.attenuation.tau
    if inputs.base.gaussians.sigma_d is None and tau < inputs.config.tau:
        notes.append(f"tau is {tau:.2g} instead of {inputs.config.tau:g}, because the Gaussians are faint")
    if adapted.lost:
        notes.append(f"training ended at step {adapted.steps}: {explain(adapted.lost)}")
    if adapted.failed:
        notes.append(f"training ended early, and the result so far is written: {adapted.failed}")
    if adapted.watched and (times := adapted.watched.rollbacks):
        what = "attributes were frozen in the end" if adapted.watched.frozen else "learning rates were halved"
        back = f"training made s = 1 worse on watched views and returned to an earlier state {times} times"
        notes.append(f"{back}: {what}; the views watched are not trained on")
    if adapted.held:
        notes.append(f"{adapted.held:,} Gaussians were not moved by some steps: their gradients were not finite")
    return notes


def measure_result(setup: Setup, inputs: Inputs, result: Result, stop: GracefulStop) -> Measurements:
    """Measures the result on the held-out views, unless the run is to end now.

    That is after a Ctrl-C that came when training was complete, and if the launcher ends the processes.

    Args:
        stop: as in ``measure``.
    """
    if setup.stop.requests > 0 and not result.adapted.interrupted or hurried(result.adapted):
        return Measurements(inputs.base_rows, interrupted=True)
    views, console = inputs.scene.test, setup.console
    with setup.watch.time("evaluate"):
        rows, interrupted = measure(result.gaussians, views, report_dials(inputs.config.max_sv), console, stop=stop)
        if interrupted:
            return Measurements(inputs.base_rows, tuple(rows), interrupted=True)
        detached = detach(result.gaussians)
        plain, interrupted = measure(detached, views, [1.0], console, "plain", stop=stop)
        base, notes = list(inputs.base_rows), list[str]()
        if not interrupted:
            measured = [(inputs.base.gaussians, base), (result.gaussians, rows), (detached, plain)]
            (base, rows, plain), notes, interrupted = with_frame_times(measured, views, console, stop)
    return Measurements(tuple(base), tuple(rows), tuple(plain), tuple(notes), interrupted)
