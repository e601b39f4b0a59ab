"""Untrusted pictures as arrays, and films: MP4 files with VP9 inside, which browsers play (PyAV, FFmpeg)."""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.files import replacing

CODEC = {"crf": "24", "b": "0", "deadline": "realtime", "cpu-used": "8"}  # constant quality; five times as fast as the default


def decoded(data: bytes, flags: int) -> Any:
    """The pixels of a PNG, a JPEG, ...; None: no picture, a broken one, or one with more pixels than `limits` allow.

    Args:
        flags: as in `cv2.imdecode`.
    """
    import cv2

    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        return None


def write_film(path: Path, pictures: Iterable[Array], fps: int) -> None:
    """Write a film atomically (`replacing`) and verify it. The same pictures give the same bytes.

    Args:
        pictures: at least one, all of one size: (height, width, 3) uint8, blue, green, red; both sides are even, px.

    Raises:
        OSError: it cannot be written, or the result is not a valid film.
    """
    import av

    with replacing(path) as place:
        try:
            count = _encode(place, pictures, fps)
            with av.open(str(place)) as film:
                read_count = sum(1 for packet in film.demux(video=0) if packet.size)
        except av.FFmpegError as error:
            raise OSError(error.errno, error.strerror) from error
        if read_count != count:
            raise OSError(f"{read_count} of {count} pictures can be read back")


def _encode(place: Path, pictures: Iterable[Array], fps: int) -> int:
    import av

    coming = iter(pictures)
    first = next(coming)
    with av.open(str(place), "w", format="mp4", options={"fflags": "+bitexact"}) as film:
        stream = film.add_stream("libvpx-vp9", rate=fps, options=CODEC)
        stream.codec_context.thread_count = 1  # the same bytes on any machine
        stream.height, stream.width = first.shape[:2]
        for count, picture in enumerate(chain([first], coming), 1):  # noqa: B007  how many there were
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")))
        film.mux(stream.encode())
    return count
