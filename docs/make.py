"""Writes the pages of the site into build/pages: those of this folder, and the reference, made from
the code. Ends where a table of a page is not what the rows of the benchmarks give.

python docs/make.py        # then mkdocs build, as make docs does
"""

import argparse
import shutil
import subprocess
import sys
from itertools import groupby
from pathlib import Path

import clod_adapter
from clod_adapter.cli.main import COMMANDS, PROG, build_parser, command_of
from clod_adapter.config import AdaptConfig, AttenuationConfig, field_descriptions

HERE = Path(__file__).resolve().parent
TABLES = HERE.parent / "benchmarks" / "results.py"
OUT = HERE.parent / "build" / "pages"
SETTINGS = """\
# Settings

Made from the config classes: frozen dataclasses with keyword arguments only, which refuse invalid
values.
`AdaptConfig.paper()` is the paper's own form; AttenuationConfig is stored in the file.

| AdaptConfig | default | paper | meaning |
|---|---|---|---|
{rows}

| AttenuationConfig | default | meaning |
|---|---|---|
{fields}
"""
INTEGRATIONS = (
    *(
        f"integrations.gsplat.{name}"
        for name in (
            "rasterization",
            "rasterization_2dgs",
            "rasterization_inria_wrapper",
            "rasterization_2dgs_inria_wrapper",
        )
    ),
    "integrations.inria.GaussianRasterizer",
)


def commands_page() -> str:
    """Usage, description, options and notes of each command, as in ``--help``."""
    parts = ["# Commands\n\nThe `--help` text of every command.\n"]
    return "\n".join(parts + [command_section(name) for name in ("", *COMMANDS)])


def command_section(name: str) -> str:
    """The section of one command; the empty name is ``clod-adapt PLY``."""
    title, command = f"{PROG} {name}".strip(), command_of(name)
    rows = [option_row(action) for action in build_parser(name)._actions if action.dest != "help"]
    table = "\n".join(["| | |", "|---|---|", *rows])
    usage, notes = (
        f"```text\n{title} {command.USAGE}\n```\n",
        f"```text\n{command.EPILOG.strip()}\n```\n",
    )
    return f"## {title}\n\n{usage}\n{command.DESCRIPTION.strip()}\n\n{table}\n\n{notes}"


def option_row(action: argparse.Action) -> str:
    """Table row of an option or argument."""
    value = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else ""
    )
    value = {"+": f"{value} [{value} ...]", "?": f"[{value}]"}.get(
        str(action.nargs), value if action.nargs != 0 else ""
    )
    text = " ".join((action.help or "").split()).replace("|", "\\|")
    return f"| `{' '.join([*action.option_strings, str(value)]).strip()}` | {text} |"


def settings_page() -> str:
    """Every field of the two configs with its default and, if different, its value in the paper's
    own form.
    """
    ours, paper, travels = AdaptConfig(), AdaptConfig.paper(), AttenuationConfig()
    rows = []
    for name, text in field_descriptions(AdaptConfig).items():
        value, other = getattr(ours, name), getattr(paper, name)
        rows.append(
            f"| `{name}` | {shown(value)} | {shown(other) if other != value else ''} | {text} |"
        )
    about = field_descriptions(AttenuationConfig)
    fields = [
        f"| `{name}` | {shown(getattr(travels, name))} | {text} |" for name, text in about.items()
    ]
    return SETTINGS.format(rows="\n".join(rows), fields="\n".join(fields))


def shown(value: object) -> str:
    return "none" if value is None else f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def names_page() -> str:
    """Every public name, by the module that defines it."""
    parts = ["# Names\n\nAll are in `clod_adapter`, except those of `clod_adapter.integrations`.\n"]
    homes = sorted((getattr(clod_adapter, name).__module__, name) for name in clod_adapter.__all__)
    for module, names in groupby(homes, key=lambda pair: pair[0]):
        parts += [f"## {module}\n", *(f"::: {module}.{name}\n" for _, name in names)]
    parts += ["## integrations\n", *(f"::: clod_adapter.{name}\n" for name in INTEGRATIONS)]
    return "\n".join(parts)


PAGES = {"commands.md": commands_page, "settings.md": settings_page, "names.md": names_page}


def main() -> None:
    if subprocess.run([sys.executable, TABLES, "--check"], check=False).returncode:
        sys.exit(1)
    shutil.rmtree(OUT, ignore_errors=True)
    shutil.copytree(HERE, OUT, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for name, make in PAGES.items():
        (OUT / name).write_text(make(), encoding="utf-8")


if __name__ == "__main__":
    main()
