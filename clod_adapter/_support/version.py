"""The package's version, which is written into files."""

from importlib import metadata


def package_version() -> str:
    """The installed version, or "0" when run from a checkout that is not installed."""
    try:
        return metadata.version("clod-adapter")
    except metadata.PackageNotFoundError:
        return "0"
