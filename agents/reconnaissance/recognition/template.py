"""What is looked for: a picture of a target, and how it looks from some height."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from vcmvsp.agents.reconnaissance.recognition.colour import Hues, hues
from vcmvsp.agents.reconnaissance.recognition.polar import COARSE, FULL, Signature
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.pictures import decoded

PATCH = 48  # px: pictures are compared at this size
CAMERA_BLUR_PX = 0.8  # standard deviation of what a pixel of the camera averages, px of its picture
SMALLEST_PX = 16  # a picture of a target has at least so many pixels a side


@dataclass(frozen=True, eq=False)
class TargetPicture:
    """A square picture of a target from above, and its true size.

    A target that is nearly its own mirror image cannot be told from it; one with rotational symmetry has several angles.
    """

    name: str
    picture: Array  # (n, n, 3) uint8, RGB; its upper edge is where the angle of a detection points
    size_m: float  # of a side

    def __post_init__(self) -> None:
        shape = self.picture.shape
        if self.picture.dtype != np.uint8 or len(shape) != 3 or shape[2] != 3:
            raise ScenarioError(
                f"a picture is an array (n, n, 3) of uint8, RGB, not {shape} of {self.picture.dtype}", key="picture"
            )
        if shape[0] != shape[1] or shape[0] < SMALLEST_PX:
            rule = f"the picture of {self.name} must be square, {SMALLEST_PX} pixels or more a side"
            raise ScenarioError(f"{rule}, not {shape[1]} x {shape[0]}", key="picture")
        if not 0.0 < self.size_m < float("inf"):
            raise ScenarioError(f"the side of {self.name} must be greater than 0 m, not {self.size_m}", key="size_m")
        if not self.template(PATCH).hues.shares:
            raise ScenarioError(f"the picture of {self.name} is grey: targets are found by their colours first", key="picture")

    @classmethod
    def load(cls, name: str, path: Path | str, size_m: float) -> "TargetPicture":
        """Reads the picture from a file (PNG, JPEG, ...)."""
        try:
            read = decoded(limits.read_bytes(Path(path), limits.FILE_BYTES), cv2.IMREAD_COLOR_RGB)
        except (OSError, ValueError) as error:
            raise ScenarioError(f"cannot read the picture of {name}: {error}", key="picture") from error
        if read is None:
            raise ScenarioError(f"{path} is not a picture that can be read{limits.PICTURE}", key="picture")
        return cls(name, read, size_m)

    def template(self, side_px: int) -> "Template":
        """The picture scaled to a side of so many pixels; cached."""
        return _template(self, side_px)


@dataclass(frozen=True, eq=False)
class Template:
    """A target at one scale, prepared for the three stages."""

    patch: Array  # (48, 48, 3) uint8
    hues: Hues
    coarse: Signature
    full: Signature
    unit: Array  # (6912,) float32: the patch less its channel means, of length 1


@lru_cache(maxsize=64)
def _template(target: TargetPicture, side_px: int) -> Template:
    patch = cv2.resize(target.picture, (PATCH, PATCH), interpolation=cv2.INTER_AREA)
    sigma = CAMERA_BLUR_PX * PATCH / side_px
    patch = cv2.GaussianBlur(patch, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    middle = 0.5 * (PATCH - 1)
    at, side = np.array([middle]), np.array([float(PATCH)])
    return Template(
        patch=patch,
        hues=hues(patch),
        coarse=COARSE.signatures(COARSE.spectra(patch, at, at, side)),
        full=FULL.signatures(FULL.spectra(patch, at, at, side)),
        unit=unit(patch[None])[0],
    )


def unit(patches: Array) -> Array:
    """Patches (n, 48, 48, 3) as rows (n, 6912) less their channel means, each of length 1: their products are correlations."""
    flat = patches.astype(np.float32).reshape(len(patches), -1, 3)
    flat -= flat.mean(axis=1, keepdims=True)
    rows = flat.reshape(len(patches), -1)
    rows /= np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), 1e-6)[:, None]
    return rows
