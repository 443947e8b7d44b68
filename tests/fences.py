"""The documentation's pages, and their commands: fenced blocks, and commands within sentences."""

import re
import shlex
import textwrap
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^( *)(`{3,})(\w*)\n(.*?)^\1\2 *$", re.DOTALL | re.MULTILINE)


class Block(NamedTuple):
    """A fenced block; ``reason`` is that of ``<!-- not run: REASON -->`` above it, and empty if it is run."""

    place: str
    language: str  # of the fence; ``sh`` for the README's, which have none
    text: str
    reason: str

    def commands(self) -> list[list[str]]:
        """The words of each line of a shell block, without comments, continued lines put together."""
        lines = self.text.replace("\\\n", " ").splitlines() if self.language in ("sh", "console") else []
        return [words for line in lines if (words := shlex.split(line.removeprefix("$ "), comments=True))]


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        marker = re.search(r"<!-- not run: ([^>]+?) -->\s*\Z", text[: match.start()])
        language = match[3] or ("sh" if page.name == "README.md" else "")
        place = f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}"
        found.append(Block(place, language, textwrap.dedent(match[4]), marker[1] if marker else ""))
    return found


def spoken(page: Path, program: str) -> list[str]:
    """Complete commands of a program with options, within sentences and in indented blocks."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    said = [each.partition("  #")[0].strip() for each in [*spans, *lines] if each.startswith(f"{program} ")]
    return [each for each in said if " -" in each and "..." not in each]
