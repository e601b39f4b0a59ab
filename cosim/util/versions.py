"""Versions of installed packages."""

from importlib import metadata

_OTHER_BUILDS = {"pybullet": "pybullet-arm64"}  # the same sources, built for other machines and versions of Python


def version_of(package: str) -> str:
    """Installed version of a package, with the name of the build if that differs: ``3.2.8 (pybullet-arm64)``.

    Raises:
        importlib.metadata.PackageNotFoundError: it is not installed.
    """
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        build = _OTHER_BUILDS.get(package)
        if build is None:
            raise
        return f"{metadata.version(build)} ({build})"
