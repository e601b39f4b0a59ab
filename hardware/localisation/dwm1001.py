"""Decawave DWM1001 (PANS firmware): positions as lines of text from the shell on its serial port, 115200 baud.

Two carriage returns within a second open the shell, and ``lep`` toggles lines of positions. A tag sends
``POS,x,y,z,quality`` (m, %), after its distances if ``lec`` was given; a listener sends, for each tag,
``POS,index,id,x,y,z,quality,check`` [DWM1001 firmware API guide, shell commands]. There is no time and no heading. Without a
check sum a line with lost bytes may still look valid: users of the positions must gate them.
"""

import math

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.types import ORIGIN, NonNegative, Positive, Vec3
from vcmvsp.hardware.drivers.byte_link import ByteLink, open_line
from vcmvsp.hardware.localisation.port_source import PortSource
from vcmvsp.hardware.localisation.source import Advice, Baud, LineReader, Located, WorldTransform

WAKE = b"\r\r"
POSITIONS = b"lep\r"
PROMPT = "dwm> "
BAUD = 115200
LONGEST_BYTES = 512  # of a line; `lec` with four anchors has 140


def decode(line: str) -> Located | None:
    """Position of a line; None if it has another subject (echo, prompt, banner), `ValueError` if it is invalid."""
    fields = line.rpartition(PROMPT)[2].strip().split(",")  # the first line follows a prompt
    if "POS" not in fields:
        return None
    values = fields[fields.index("POS") + 1 :]
    if len(values) == 4:
        tag, numbers = "", values
    elif len(values) == 7:
        tag, numbers = values[1], values[2:6]
    else:
        raise ValueError(f"POS has 4 fields, or 7 from a listener, not {len(values)}")
    x, y, z, percent = map(float, numbers)
    if not 0.0 <= percent <= 100.0:
        raise ValueError(f"a quality is from 0 to 100 %, not {percent}")
    valid = percent > 0.0 and all(map(math.isfinite, (x, y, z)))  # a lost tag sends nan, or quality 0
    return Located(tag=tag, position=(x, y, z) if valid else None, quality=percent / 100.0)


def encode(located: Located, index: int | None = None) -> bytes:
    """Line of a position, of a tag or, with an index, of a listener; for emulation."""
    x, y, z = located.position or (math.nan, math.nan, math.nan)
    quality = 1.0 if located.quality is None else located.quality
    percent = 0 if located.position is None else round(100.0 * quality)
    body = f"{x:.2f},{y:.2f},{z:.2f},{percent}"
    prefix = "" if index is None else f"{index},{located.tag},"
    return f"POS,{prefix}{body}{'' if index is None else ',x00'}\r\n".encode()


class Waker:
    """Decides what to write to the port so that positions come. ``lep`` is a toggle: it is not sent while lines arrive.

    A tag at rest may send rarely, and a second ``lep`` would switch it off; so the waiting time doubles each time.
    """

    def __init__(self, patience_s: float = 2.0) -> None:
        self._patience_ns = seconds_to_ns(patience_s)
        self._due_ns: int | None = None
        self._awake = False

    def position_arrived(self, now_ns: int) -> None:
        """Note that a position arrived."""
        self._awake, self._due_ns = False, now_ns + self._patience_ns

    def write(self, now_ns: int) -> bytes:
        """Bytes to write now, mostly none; call it several times a second."""
        if self._due_ns is None:
            self._due_ns = now_ns + self._patience_ns
        if now_ns < self._due_ns:
            return b""
        if not self._awake:
            self._awake, self._due_ns = True, now_ns + SECOND_NS  # time for the shell to open
            return WAKE
        self._patience_ns *= 2
        self._awake, self._due_ns = False, now_ns + self._patience_ns
        return POSITIONS


class Tag:
    """A tag's side of the port, for emulation: the shell with ``lep`` and ``quit``.

    An empty line ends ``lep``; ``quit`` does not: lines continue when the shell is opened again [client pydwm1001].
    """

    def __init__(self) -> None:
        self.shell = self.telling = False
        self._typed = b""

    def receive(self, chunk: bytes) -> bytes:
        """Answer of the tag to bytes written to its port."""
        answer = b""
        for byte in chunk.replace(b"\n", b"\r"):
            self._typed += bytes([byte])
            if not self.shell:
                if self._typed.endswith(WAKE):
                    self.shell, self._typed = True, b""
                    answer += b"\r\nDWM1001 TWR Real Time Location System\r\n\r\ndwm> "
            elif byte == 0x0D:
                command, self._typed = self._typed.strip(), b""
                if command == b"lep":
                    self.telling = not self.telling
                elif command == b"quit":
                    self.shell = False
                elif not command:
                    self.telling = False
                answer += command + b"\r\ndwm> "
        return answer

    def say(self, located: Located) -> bytes:
        """Line of a position; empty while lines are off."""
        return encode(located) if self.shell and self.telling else b""


class Dwm1001(PortSource):
    """A Decawave DWM1001 tag, or a listener, on a serial port; the driver switches its positions on.

    Args:
        port: such as ``/dev/ttyACM0``.
        baud: of the port.
        tag: name of the vehicle's tag, if a listener reports several; empty: the only one.
        sigma_m: standard deviation of x and y.
        latency_s: delay from measurement to arrival.
        offset: of the system's frame in the world, m.
        turn_rad: of its frame in the world.
    """

    def __init__(
        self,
        *,
        port: str,
        baud: Baud = BAUD,
        tag: str = "",
        sigma_m: Positive = 0.15,
        latency_s: NonNegative = 0.1,
        offset: Vec3 = ORIGIN,
        turn_rad: float = 0.0,
    ) -> None:
        words = Advice(
            "check that the module is on, and its port", "the bytes are not lines of a DWM1001: check port and baud rate"
        )
        transform = WorldTransform(tag=tag, sigma_m=sigma_m, latency_s=latency_s, offset=offset, turn_rad=turn_rad)
        super().__init__(port, LineReader(decode, LONGEST_BYTES), transform, words)
        self._baud = baud

    def _open_line(self) -> ByteLink:
        self._waker = Waker()  # the module restarts when it is plugged in
        return open_line(self.device, self._baud)

    def _say(self, now_ns: int) -> bytes:
        return self._waker.write(now_ns)

    def take(self, chunk: bytes, arrived_ns: int) -> bool:
        """Decode bytes; a module that sends positions is not switched."""
        has_positions = super().take(chunk, arrived_ns)
        if has_positions:
            self._waker.position_arrived(arrived_ns)
        return has_positions
