"""README's Python passes mypy --strict, as a program of one's own would."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fences import ROOT, blocks


@pytest.mark.timeout(300)  # of which most is the first time that mypy reads torch
def test_the_readmes_python_is_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    api = pytest.importorskip("mypy.api")
    found = [block for block in blocks(ROOT / "README.md") if block.language == "python" and not block.reason]
    files = [tmp_path / f"line_{block.line}.py" for block in found]
    for file, block in zip(files, found, strict=True):
        file.write_text(block.text, encoding="utf-8")
    monkeypatch.setenv("MYPYPATH", str(ROOT))  # an editable installation is not found otherwise
    options = ["--strict", "--follow-imports=silent", "--python-executable", sys.executable]
    cache = f"--cache-dir={ROOT / '.mypy_cache' / 'readme'}"
    printed, errors, code = api.run([*options, cache, *map(str, files)])
    assert files and code == 0, printed + errors
