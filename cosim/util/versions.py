"""Versions of installed packages."""

import contextlib
from collections.abc import Iterable
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


def versions_of(packages: Iterable[str]) -> dict[str, str]:
    """Versions of those packages that are installed."""
    versions = {}
    for package in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = version_of(package)
    return versions
