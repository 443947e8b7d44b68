"""The built page belongs to its sources."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

VIEWER = Path(__file__).resolve().parents[2] / "clod_adapter" / "viewer"


def test_the_bundle_is_of_these_sources() -> None:
    """Whoever changes the sources builds: npm ci && npm run build, in clod_adapter/viewer/web."""
    web = VIEWER / "web"
    if not web.is_dir():
        pytest.skip("the sources of the page are in a checkout only")
    lines = (VIEWER / "static" / "SOURCES.sha256").read_text(encoding="utf-8").splitlines()
    listed = {name: digest for digest, name in (line.split("  ") for line in lines)}
    files = [path for path in web.rglob("*.*") if path.is_file() and "node_modules" not in path.parts]
    found = {path.relative_to(web).as_posix(): path for path in files if path.name != ".gitignore"}
    assert set(listed) == set(found)
    for name, path in found.items():
        assert listed[name] == hashlib.sha256(path.read_bytes()).hexdigest(), f"{name} has changed since: build again"
