"""Commands of the documentation: fenced blocks and commands within sentences, parsed and run."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
import textwrap
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

from clod_adapter.cli.main import COMMANDS, build_parser, main
from runs import accepted

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^( *)(`{3,})(\w*)\n(.*?)^\1\2 *$", re.DOTALL | re.MULTILINE)
SHELL = ("sh", "console")
LANGUAGES = {*SHELL, "python", "text", "json", "glsl", "wgsl", "html", "css", "js"}

STEPS = 20  # of a training that the pages run

# Commands that are not run, wherever they stand, and why.
SKIPPED = {
    "pip": "would change the environment that the tests run in",
    "make": "makes an environment of its own; make test is what runs this",
    "clod-adapt demo": "takes a minute; tests/cli/test_demo.py runs it with the long parts replaced",
}


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        language: of the fence; ``sh`` for the README's, which have none.
        reason: why it is not run, from ``<!-- not run: REASON -->`` above it; empty if it is run.
    """

    page: Path
    line: int
    language: str
    text: str
    reason: str

    @property
    def place(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    def commands(self) -> list[list[str]]:
        """The words of each line of a shell block, without comments, continued lines put together."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line.removeprefix("$ "), comments=True))]


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        marker = re.search(r"<!-- not run: ([^>]+?) -->\s*\Z", text[: match.start()])
        language = match[3] or ("sh" if page.name == "README.md" else "")
        line = text.count("\n", 0, match.start()) + 1
        found.append(Block(page, line, language, textwrap.dedent(match[4]), marker[1] if marker else ""))
    return found


def spoken(page: Path, program: str) -> list[str]:
    """Complete commands of a program with options, within sentences and in indented blocks."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    said = [each.partition("  #")[0].strip() for each in [*spans, *lines] if each.startswith(f"{program} ")]
    return [each for each in said if " -" in each and "..." not in each]


def parse(words: list[str]) -> None:
    """Raises ClodError for unknown options of ``clod-adapt``."""
    words = words[: words.index(">")] if ">" in words else words
    name = words[1] if len(words) > 1 and words[1] in COMMANDS else ""
    build_parser(name).parse_args(words[2:] if name else words[1:])


def run(words: list[str]) -> None:
    """Runs a command of a shell block in the current folder, training for STEPS steps at most.

    Raises:
        ValueError: the program is unknown, or its exit code is not 0.
    """
    out: Path | None = None
    if ">" in words:
        words, out = words[: words.index(">")], Path(words[-1])
    runners: dict[str, Callable[[list[str]], None]] = {"clod-adapt": _run_clod_adapt, "python": _run_python}
    if words[0] not in runners:
        raise ValueError(f"{words[0]}: not known here; mark the block with <!-- not run: REASON -->")
    if out is None:
        runners[words[0]](words)
        return
    with out.open("w", encoding="utf-8") as stream, redirect_stdout(stream):
        runners[words[0]](words)


def _run_clod_adapt(words: list[str]) -> None:
    code = main(accepted(shortened(words[1:])))
    if code:
        raise ValueError(f"{shlex.join(words)}: exit code {code}")


def shortened(words: list[str]) -> list[str]:
    """The words of a training command with ``--iters`` at most STEPS; other commands as they are."""
    if words[0] in COMMANDS and words[0] != "robustness":
        return words
    if "--iters" not in words:
        return [*words, "--iters", str(STEPS)]
    at = words.index("--iters") + 1
    return [*words[:at], str(min(int(words[at]), STEPS)), *words[at + 1 :]]


def _run_python(words: list[str]) -> None:
    before = sys.argv
    sys.argv = words[1:]
    try:
        runpy.run_path(str(ROOT / words[1]), run_name="__main__")
    finally:
        sys.argv = before


def skipped(words: list[str]) -> str:
    """The reason why a command is never run; empty if it is run."""
    return SKIPPED.get(words[0], "") or SKIPPED.get(" ".join(words[:2]), "")
