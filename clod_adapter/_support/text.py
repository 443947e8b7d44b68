"""Text for outputs: file names, which to the system are bytes and need not be text; messages; the
version.
"""

import json
import os
from typing import Any


def as_text(name: str) -> str:
    """``name`` as text that UTF-8 can encode; valid text is unchanged.

    A lone surrogate of a byte of a file name (PEP 383) becomes a character if it is valid UTF-8
    with its neighbours, else ``\\xff``; other surrogates become ``\\ud800``.
    """
    try:
        data = name.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        data = name.encode("utf-8", "backslashreplace")
    return data.decode("utf-8", "backslashreplace")


def file_name(text: str) -> str:
    """The file name whose bytes are ``text`` in UTF-8, as a COLMAP model or a JSON file has it, in
    any locale.
    """
    return os.fsdecode(text.encode("utf-8"))


def first_line(error: BaseException) -> str:
    """The first line of an error's message that is not blank, or its type."""
    return next(
        (line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__
    )


def script_json(value: Any) -> str:
    """JSON without <, so that no text in it can end an HTML script element, or begin a comment in
    it.
    """
    return json.dumps(value, allow_nan=False, ensure_ascii=False).replace("<", "\\u003c")


def package_version() -> str:
    """The installed version, or "0" when run from a checkout that is not installed."""
    from importlib import metadata  # here: it takes as long as the rest of --help

    try:
        return metadata.version("clod-adapter")
    except metadata.PackageNotFoundError:
        return "0"
