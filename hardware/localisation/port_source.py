"""A source of positions on a byte link: a thread reads it, and opens it again after a loss."""

import contextlib
import os
import threading
import time
from collections.abc import Callable

from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.drivers.base import LinkLost, PortError
from vcmvsp.hardware.drivers.byte_link import ByteLink
from vcmvsp.hardware.localisation.readers import DatagramReader, LineReader
from vcmvsp.hardware.localisation.source import Advice, PositionSource, as_failure
from vcmvsp.hardware.localisation.world_transform import WorldTransform

RETRY_S = 0.5
TICK_S = 0.1  # period of writing
CLOSE_S = 5.0  # opening a TCP connection takes 2 s at most


class PortSource(PositionSource):
    """Reads a link and writes to it.

    Args:
        open_line: opens the link, or raises `PortError`.
        say: bytes to write at a time (ns), mostly none; called several times a second.
    """

    def __init__(
        self,
        device: str,
        reader: DatagramReader | LineReader,
        transform: WorldTransform,
        words: Advice,
        *,
        open_line: Callable[[], ByteLink],
        say: Callable[[int], bytes] = lambda _: b"",
    ) -> None:
        super().__init__(device, reader, transform, words)
        self._open_line, self._say = open_line, say
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Open the port and start reading.

        Raises:
            PortError: it cannot be opened.
        """
        self._begin()
        line = self._open_line()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, args=(line,), name=f"positions {self.device}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Free the port. May be called twice."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        os.write(self._wake_write, b"x")
        thread.join(CLOSE_S)
        if not thread.is_alive():  # otherwise the descriptors are still in use
            os.close(self._wake_read)
            os.close(self._wake_write)

    def _run(self, line: ByteLink | None) -> None:
        try:
            while True:
                if line is None:
                    if self._woken(RETRY_S):
                        return
                    with contextlib.suppress(PortError):
                        line = self._open_line()
                        self.back()
                    continue
                try:
                    if self._woken(TICK_S, line):
                        return
                except LinkLost as error:
                    line.close()
                    line = None
                    self.lost(f"{error.happened}; {error.advice}")
        except Exception as error:  # an error of the reader
            self.failed(as_failure(self.device, error))
        finally:
            if line is not None:
                line.close()

    def _woken(self, seconds: float, line: ByteLink | None = None) -> bool:
        """Read and write for at most ``seconds``; whether to stop."""
        ready = readable([self._wake_read] if line is None else [self._wake_read, line.fileno()], seconds)
        if self._wake_read in ready:
            return True
        if line is not None:
            if ready and (chunk := line.read()):
                self.take(chunk, time.monotonic_ns())
            if words := self._say(time.monotonic_ns()):
                line.write(words)
        return False
