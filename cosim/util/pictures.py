"""Pictures from outside, as arrays."""

from typing import Any

import numpy as np

from vcmvsp.cosim.util import limits  # noqa: F401  tells OpenCV how many pixels are too many


def decoded(data: bytes, flags: int) -> Any:
    """The pixels of a PNG, a JPEG, ...; None: it is no picture, a broken one, or one of more pixels than `limits` allow.

    Args:
        data: of the file.
        flags: of `cv2.imdecode`.
    """
    import cv2

    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        return None
