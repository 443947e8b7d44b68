"""The options of the plan, and what ``--help`` says of it."""

from __future__ import annotations

from argparse import ArgumentParser

# As in clod_adapter.plan, which would import torch; a test compares the two.
NAMES = ("bands", "unseen", "means", "quats", "scales", "opacities", "sh0")

PLAN = """\
Before training a plan is printed: what the scene does not need, by which
number, and the option that overrules it. Higher SH bands are left out where the
training views change by less than 0.02 dB without them, Gaussians where they
move no pixel of any, and an attribute is frozen where tuning it can do less
than 0.02 dB. What was left out is in OUT.ply as it was; with --trim it is not,
and OUT.ply is smaller. --with and --without settle it beforehand, for bands,
unseen (Gaussians), means, quats, scales, opacities and sh0. A training of fewer
than 300 steps freezes no attribute by itself.
"""


def add_plan_options(parser: ArgumentParser) -> None:
    for option, dest, what in (
        ("--with", "keep_in", "train with these, whatever the plan would find: "),
        ("--without", "leave_out", "leave these out or frozen, likewise"),
    ):
        names = ", ".join(NAMES) if dest == "keep_in" else ""
        parser.add_argument(
            option, dest=dest, metavar="NAME", nargs="+", action="extend", choices=NAMES, default=[], help=what + names
        )
    parser.add_argument("--trim", action="store_true", help="do not write the bands and Gaussians that were left out")
