"""Names of files as text that every output can hold: a name is bytes to the system, and may be no text at all."""

from __future__ import annotations

import os


def as_text(name: str) -> str:
    """``name`` as text that UTF-8 can encode; a name that is such text already is unchanged.

    Python holds a byte of a file name that the locale's encoding cannot decode as a lone surrogate, U+DC80 to U+DCFF
    (PEP 383). Bytes that are UTF-8 together become their letter, as under an ASCII locale; others become ``\\xff``, and
    a surrogate that stands for no byte becomes ``\\ud800``.
    """
    try:
        data = name.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        data = name.encode("utf-8", "backslashreplace")
    return data.decode("utf-8", "backslashreplace")


def file_name(text: str) -> str:
    """The file name whose bytes are ``text`` in UTF-8, as a COLMAP model or a JSON file has it, in any locale."""
    return os.fsdecode(text.encode("utf-8"))


def first_line(error: BaseException) -> str:
    """The first line of an error's message that is not blank."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "no message")
