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
    listed = {(web / name).resolve(): digest for digest, name in (line.split("  ") for line in lines)}
    assert {path for path in (web / "src").rglob("*.*") if path.is_file()} <= set(listed)
    for path, digest in listed.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == digest, f"{path} has changed since: build again"
