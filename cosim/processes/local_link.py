"""The link between a run and a process of its own on this machine: whole messages, and nobody ever waits for the other side.

A pair of local sockets that keep messages apart (``SOCK_SEQPACKET``): what does not go at once does not go at all, so that
half a message is never on its way, and a side that hangs cannot hold the other. When a process ends, however, the other
side reads the end of the link.
"""

import errno
import socket

from vcmvsp.cosim.util.polling import readable

LONGEST = 1 << 18  # bytes of a message; the operating system takes some 200 kB


def pair() -> tuple["LocalLink", socket.socket]:
    """A link, and the end of it that a child process is to inherit."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return LocalLink(here), there


class LocalLink:
    """One end.

    Attributes:
        ended: the other side has gone; what it had said before was received.
    """

    def __init__(self, end: socket.socket) -> None:
        self._socket, self.ended = end, False
        end.setblocking(False)

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def send(self, message: bytes) -> bool:
        """Whether it went: not if the other side has stopped reading, or has gone.

        Raises:
            ValueError: it is longer than any message can be, and will never go.
        """
        try:
            self._socket.send(message)
        except (BlockingIOError, BrokenPipeError, ConnectionResetError):
            return False
        except OSError as error:
            if error.errno != errno.EMSGSIZE:
                raise
            raise ValueError(f"a message of {len(message)} bytes is longer than the link takes") from None
        return True

    def receive(self) -> list[bytes]:
        """All that has come.

        Raises:
            ValueError: a message was longer than `LONGEST`, and the end of it is missing.
        """
        messages = []
        while not self.ended:
            try:
                message, _, flags, _ = self._socket.recvmsg(LONGEST)
            except BlockingIOError:
                break
            except ConnectionResetError:  # it went without reading everything; it is said once, before its last words
                continue
            if flags & socket.MSG_TRUNC:
                raise ValueError(f"a message was longer than {LONGEST} bytes")
            if message:
                messages.append(message)
            else:
                self.ended = True
        return messages

    def wait(self, seconds: float) -> None:
        """Until something has come, at most so long."""
        readable([self._socket.fileno()], max(seconds, 0.0))

    def close(self) -> None:
        """Let the other side read the end of the link."""
        self._socket.close()
