"""Cameras: pictures of the world and the bodies in it, of a pinhole without distortion."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

import msgspec
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array, Image, NonNegative, Positive, Vec3, frozen
from vcmvsp.physics.render.renderer import render
from vcmvsp.physics.render.triangles import View
from vcmvsp.physics.sensors.sensor import Sensor
from vcmvsp.physics.world.world import Scene

Pixels = Annotated[int, msgspec.Meta(ge=1, le=8192)]
Angle = Annotated[float, msgspec.Meta(gt=0, lt=math.pi)]

LOWEST_M = 0.005  # minimum height: a camera pressed into the solid floor, or tipped over, lies on it

_BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along the body x axis, upright


@dataclass(kw_only=True)
class Camera(Sensor):
    """Looks ahead and upright, unless it is turned; gives an `Image` (kind ``camera``).

    The picture is sampled at the middles of its pixels, without blur, distortion and shadows.
    """

    on_demand: ClassVar[bool] = True

    width: Pixels = 160  # of the picture, px
    height: Pixels = 120  # of the picture, px
    field_of_view: Angle = 1.2  # horizontal, rad; pixels are square
    mount: Vec3 = (0.0, 0.0, 0.2)  # the pinhole, m, body frame, from the vehicle's reference point
    yaw: float = 0.0  # rad; where it looks: turned to the left by this first
    pitch: float = 0.0  # rad; downwards by this, after yaw
    roll: float = 0.0  # rad; about its optical axis, after yaw and pitch: its right side downwards
    noise: NonNegative = 0.0  # standard deviation of each pixel and colour, levels of 255
    depth: bool = False  # whether the image has depths too
    range_max: Positive = 500.0  # m along the optical axis: solids and bodies beyond are not seen, depths beyond are inf

    def __post_init__(self) -> None:
        for key in ("width", "height"):
            if getattr(self, key) < 1:
                raise ScenarioError(f"must be at least 1 pixel, not {getattr(self, key)}", key=key)
        if not 0.0 < self.field_of_view < math.pi:
            raise ScenarioError(f"must lie between 0 and pi rad, not {self.field_of_view}", key="field_of_view")

    @property
    def focal_px(self) -> float:
        """Focal length, px."""
        return 0.5 * self.width / math.tan(0.5 * self.field_of_view)

    @cached_property
    def body_from_camera(self) -> Array:
        """Rotation, (3, 3); the camera's x axis points to the right of the picture, y down, z along the optical axis."""
        (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (self.yaw, self.pitch, self.roll))
        about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
        about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
        return np.asarray(about_z @ about_y @ about_x @ _BODY_FROM_CAMERA)

    def view(self, scene: Scene, row: int) -> View:
        """View of the camera on a vehicle."""
        eye = scene.point(row, self.mount).copy()
        eye[2] = max(eye[2], LOWEST_M)
        turned = scene.rotation(row) @ self.body_from_camera
        return View(eye, turned, self.width, self.height, self.focal_px, self.range_max)

    def measure(self, scene: Scene, row: int, rng: np.random.Generator) -> Image:
        """A picture of the scene without the camera's own vehicle."""
        picture = render(scene.world, self.view(scene, row), scene=scene, without=row, depth=self.depth)
        pixels, depth_m = picture.pixels, None if picture.depth_m is None else _read_only(picture.depth_m)
        if self.noise > 0.0:
            added = rng.standard_normal(pixels.shape, np.float32) * np.float32(self.noise)
            pixels = np.rint(np.clip(pixels + added, 0.0, 255.0)).astype(np.uint8)
        return Image(pixels=_read_only(pixels), time_ns=scene.now_ns, focal_px=self.focal_px, depth_m=depth_m)


@dataclass(kw_only=True)
class NadirCamera(Camera):
    """Looks straight down from a vehicle that flies; the picture's upper edge is ahead (kind ``nadir_camera``)."""

    mount: Vec3 = (0.0, 0.0, -0.05)  # the pinhole, m, body frame, from the vehicle's reference point
    pitch: float = 0.5 * math.pi  # straight down


def _read_only(array: Array) -> Array:
    """A read-only view of an array without other references."""
    array.flags.writeable = False
    return frozen(array)
