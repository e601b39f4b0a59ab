"""Front door: what `vcmvsp.cosim` offers, loaded on first use."""

from typing import TYPE_CHECKING, Any

from vcmvsp import cosim

if TYPE_CHECKING:
    from vcmvsp.cosim import *  # noqa: F403

__all__ = cosim.__all__


def __getattr__(name: str) -> Any:
    return getattr(cosim, name)
