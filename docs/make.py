"""Writes what of the documentation a program makes: the commands, the settings, and the equation's picture.

    python docs/make.py

Tests compare the two pages with the parsers and the configs. The picture needs matplotlib (``pip install '.[plots]'``).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import clod_adapter  # noqa: F401  (before torch)
from clod_adapter.cli.commands.adapt import ADAPT
from clod_adapter.cli.commands.command import Command
from clod_adapter.cli.main import COMMANDS, PROG, build_parser
from clod_adapter.config import AdaptConfig, AttenuationConfig, describe

HERE = Path(__file__).resolve().parent
PICTURE = HERE / "images" / "equation.png"
SIGMAS = (0.2, 0.4, 0.8)
OPACITY, TAU = 0.8, 0.02


SETTINGS = """\
# Settings

Written by `python docs/make.py` from the configs themselves. Both are frozen, take keywords only, and refuse
values that make no sense.

## AdaptConfig

How an adaptation is run: `clod.adapt(gaussians, scene, clod.AdaptConfig(max_sv=5, iters=400))`. On the
command line there are `--max-sv`, `--iters`, `--batch`, `--time-budget`, `--seed` and `--form`; the rest is
for experiments, and [Method](method.md) says what each was measured to do. `AdaptConfig.paper()` is the paper's
own form.

| field | default | paper | what |
|---|---|---|---|
{rows}

## AttenuationConfig

How `sigma_d` is to be read: the constants of [the equation](equation.md), which travel with the file. The
defaults are what adapting writes by default, and how [a file without a
description](formats.md#when-a-tool-drops-the-description) is read.

| field | default | what |
|---|---|---|
{fields}
"""


def commands_page() -> str:
    """The reference, in Markdown: of each command its usage, description, options and notes, as ``--help`` has them."""
    parts = [
        "# Commands\n\n"
        "What `--help` says, of every command. Written by `python docs/make.py` from the parsers themselves.\n"
    ]
    parts += [command_section(name, command) for name, command in [("", ADAPT), *COMMANDS.items()]]
    return "\n".join(parts)


def command_section(name: str, command: Command) -> str:
    """One command; the empty name is the main job."""
    title = f"{PROG} {name}".strip()
    rows = [option_row(action) for action in build_parser(name)._actions if action.dest != "help"]
    table = "\n".join(["| | |", "|---|---|", *rows])
    return (
        f"## {title}\n\n{fence(f'{title} {command.usage}')}\n{command.description.strip()}\n\n{table}\n\n"
        f"{fence(command.epilog.strip())}"
    )


def option_row(action: argparse.Action) -> str:
    """An option or argument with its value and its help. Not by argparse, which formats them differently by version."""
    names = " ".join(action.option_strings)
    value = action.metavar or ("{" + ",".join(map(str, action.choices)) + "}" if action.choices else "")
    value = {"+": f"{value} [{value} ...]", "?": f"[{value}]"}.get(
        str(action.nargs), value if action.nargs != 0 else ""
    )
    text = " ".join((action.help or "").split()).replace("|", "\\|")
    return f"| `{f'{names} {value}'.strip()}` | {text} |"


def settings_page() -> str:
    """Every field of the two configs, with its default, and where the paper's own form has another, that."""
    ours, paper, travels = AdaptConfig(), AdaptConfig.paper(), AttenuationConfig()
    rows = []
    for name, text in describe(AdaptConfig).items():
        value, other = getattr(ours, name), getattr(paper, name)
        rows.append(f"| `{name}` | {shown(value)} | {shown(other) if other != value else ''} | {text} |")
    about = describe(AttenuationConfig)
    fields = [f"| `{name}` | {shown(getattr(travels, name))} | {text} |" for name, text in about.items()]
    return SETTINGS.format(rows="\n".join(rows), fields="\n".join(fields))


def shown(value: object) -> str:
    if value is None:
        return "none"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def fence(text: str) -> str:
    return f"```text\n{text}\n```\n"


def equation_picture(path: Path) -> None:
    """Left: opacity against distance, for three decays. Right: the same Gaussians over the dial, and the cut."""
    import torch

    from clod_adapter.attenuation import attenuate
    from clod_adapter.config import AttenuationConfig
    from clod_adapter.report.style import INK, ORANGE, QUIET, label_log, new_figure, save, shades, tidy

    def drawn(sigma: float, distances: Sequence[float], dials: Sequence[float], cut: str) -> list[float]:
        config, logit = AttenuationConfig(tau=TAU, cut=cut), torch.tensor([OPACITY]).logit()
        each = zip(distances, dials, strict=True)
        return [float(attenuate(logit, torch.tensor([sigma]), torch.tensor([d]), s, config).drawn) for d, s in each]

    across = [k / 400 for k in range(401)]
    over = [1.002**k for k in range(1300)]
    with new_figure((8.4, 3.2), layout="constrained") as figure:
        left, right = figure.subplots(1, 2)
        for sigma, colour in zip(SIGMAS, shades(len(SIGMAS)), strict=True):
            left.plot(across, drawn(sigma, across, [1.0] * len(across), "soft"), color=colour, linewidth=1.8)
            right.plot(over, drawn(sigma, [0.3] * len(over), over, "hard"), color=colour, linewidth=1, linestyle=":")
            right.plot(over, drawn(sigma, [0.3] * len(over), over, "soft"), color=colour, linewidth=1.8)
            spot = 1.4 * sigma if sigma == SIGMAS[0] else sigma  # lower, where the next line leaves room
            height = drawn(sigma, [spot], [1.0], "soft")[0]
            left.annotate(f"$\\sigma_d$ = {sigma:g}", (spot, height), (4, 2), textcoords="offset points", fontsize=8.5)
        right.plot(over, [TAU * s for s in over], color=ORANGE, linewidth=1.2)
        right.annotate("$\\tau s$", (over[-1], TAU * over[-1]), (-14, 6), textcoords="offset points", color=ORANGE)
        left.set_title("at s = 1, by distance", fontsize=9.5, color=INK, loc="left")
        right.set_title("at d = 0.3, by the dial; dotted: the hard cut", fontsize=9.5, color=INK, loc="left")
        left.set_xlabel("normalised distance d")
        right.set_xlabel("dial s (log scale)")
        left.set_ylabel("opacity that is drawn")
        right.set_xscale("log")
        label_log(right.xaxis, "{:g}")
        for axes in (left, right):
            axes.set_ylim(0, 0.9)
            axes.tick_params(colors=QUIET)
            tidy(axes)
        save(figure, path)


def main() -> None:
    for name, make in PAGES.items():
        (HERE / name).write_text(make(), encoding="utf-8")
    equation_picture(PICTURE)
    print(f"wrote {', '.join(PAGES)} and {PICTURE.relative_to(HERE)}")


PAGES = {"commands.md": commands_page, "settings.md": settings_page}


if __name__ == "__main__":
    main()
