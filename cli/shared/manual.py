"""The documentation on this machine: the pages of a checkout, or those installed with the package."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

PAGE = "index.md"
INSTALLED = ("doc", "clod-adapter", PAGE)  # the end of its path; pyproject.toml's data-files


def manual() -> Path | None:
    """The first page; None where the pages are not installed."""
    checkout = Path(__file__).resolve().parents[2] / "docs" / PAGE
    if checkout.is_file():
        return checkout
    try:
        files = metadata.files("clod-adapter") or []
    except metadata.PackageNotFoundError:
        return None
    found = (Path(str(file.locate())).resolve() for file in files if file.parts[-3:] == INSTALLED)
    return next((page for page in found if page.is_file()), None)
