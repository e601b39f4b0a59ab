"""Which pictures of a camera are recorded: all in which something was recognised, and now and then the pixels themselves."""

import cv2

from vcmvsp.agents.reconnaissance.watch import WatchFrame
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Image, Sightings

NOTHING_NS = seconds_to_ns(5.0)  # period of recorded pictures without a target
QUALITY = 80  # of JPEG, in percent


class PictureRecording:
    """Selects the pictures of one camera for the recording.

    Args:
        camera: its name.
        picture_s: period of recorded pictures with a target in them, s.
    """

    def __init__(self, camera: str, picture_s: float) -> None:
        self._camera, self._every_ns = camera, seconds_to_ns(picture_s)
        self._kept_ns: int | None = None  # time of the last recorded picture

    def of(self, frame: WatchFrame) -> Sightings | None:
        """What is recorded of a picture; None: nothing."""
        wait_ns = self._every_ns if frame.sightings else max(self._every_ns, NOTHING_NS)
        keep = self._kept_ns is None or frame.time_ns - self._kept_ns >= wait_ns
        if not (keep or frame.sightings):
            return None
        if keep:
            self._kept_ns = frame.time_ns
        return Sightings(
            sensor=self._camera,
            time_ns=frame.time_ns,
            width=frame.nadir.width,
            height=frame.nadir.height,
            found=frame.sightings,
            jpeg=_jpeg(frame.image) if keep else b"",
        )


def _jpeg(image: Image) -> bytes:
    _, coded = cv2.imencode(".jpg", cv2.cvtColor(image.pixels, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    return coded.tobytes()
