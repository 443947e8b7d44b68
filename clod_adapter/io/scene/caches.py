"""The folder in which a user's programs keep what they can make again."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from clod_adapter.errors import ClodError


def user_caches() -> Path:
    """``$XDG_CACHE_HOME``, or where the platform has its users' caches; it need not be there.

    Raises:
        ClodError: there is neither that nor a home folder.
    """
    if chosen := os.environ.get("XDG_CACHE_HOME"):
        return Path(chosen)
    try:
        home = Path.home()
    except RuntimeError as error:
        raise ClodError("no home folder to keep undistorted photographs in; set XDG_CACHE_HOME to a folder") from error
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    return home / "Library" / "Caches" if sys.platform == "darwin" else home / ".cache"
