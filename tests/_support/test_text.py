import os

import pytest

from clod_adapter._support.text import as_text, file_name
from clod_adapter.errors import ClodError


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("garden.ply", "garden.ply"),
        ("gärten/日本.ply", "gärten/日本.ply"),
        ("\udcc3\udca4.ply", "ä.ply"),  # under an ASCII locale
        ("a\udcff.ply", "a\\xff.ply"),
        ("ä\udcff\ud800.ply", "ä\\udcff\\ud800.ply"),
    ],
)
def test_names_as_text(name: str, text: str) -> None:
    assert as_text(name) == text and text.encode()


def test_names_on_disk_and_in_errors() -> None:
    assert os.fsencode(file_name("gärten/日本.ply")) == "gärten/日本.ply".encode()
    assert str(ClodError("a\udcff.ply: is damaged\x1b[2J")) == "a\\xff.ply: is damaged [2J"
