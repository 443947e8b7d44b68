from __future__ import annotations

from pathlib import Path

import pytest

from clod_adapter.errors import ClodError
from clod_adapter.io.scene.folder import name_parts, user_caches


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a" * 300 + ".png", "is no file's name"), ("a/" * 2500 + "b.png", "is no file's name"),
        ("\u00e9" * 130, "is no file's name"), ("a\x00b.png", "is no file's name"), ("a\nb.png", "is no file's name"),
        ("\x1b[2J.png", "is no file's name"), ("a\x9b2J.png", "is no file's name"), ("\ud800.png", "is not UTF-8"),
        ("", "leaves the images folder"), ("../a.png", "leaves the images folder"),
        ("sub/../../a.png", "leaves the images folder"), ("/etc/a.png", "leaves the images folder"),
        ("..\\a.png", "leaves the images folder"), ("C:\\a.png", "leaves the images folder"),
    ],
)  # fmt: skip
def test_invalid_image_names_are_refused(name: str, message: str) -> None:
    with pytest.raises(ClodError, match=f"transforms.json: image name .*{message}") as caught:
        name_parts(name, Path("transforms.json"))
    assert str(caught.value).isprintable()


def test_unusual_image_names_are_split() -> None:
    for name in ("\u00e4\u00f6 \u00fc/\u65e5\u672c (1).png", "a.b/c d.png", "~/a.png", "$HOME.png", "x\u202fPM.png"):
        assert name_parts(name, Path("model")) == tuple(name.split("/"))
    assert name_parts("sub\\a.png", Path("model")) == ("sub", "a.png")


def test_cache_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/there")
    assert user_caches() == Path("/there")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError))
    with pytest.raises(ClodError, match="set XDG_CACHE_HOME"):
        user_caches()
