"""The package's version, which is written into files."""


def package_version() -> str:
    """The installed version, or "0" when run from a checkout that is not installed."""
    from importlib import metadata  # here: it takes as long as the rest of --help

    try:
        return metadata.version("clod-adapter")
    except metadata.PackageNotFoundError:
        return "0"
