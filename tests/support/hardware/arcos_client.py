"""Client of an emulated robot, without a serial line and without a clock."""

from vcmvsp.cosim.types import Vec3
from vcmvsp.hardware.drivers.arcos.protocol import Command, PacketReader, Sip, command, decode_sip, is_sip
from vcmvsp.hardware.drivers.arcos.robot_parameters import ROBOTS
from vcmvsp.hardware.emulators.arcos.device import Device

AMIGO = ROBOTS["amigo"]
SECOND = 1_000_000_000


class Client:
    """Talks to a device in its own time."""

    def __init__(self, device: Device) -> None:
        self.device, self.reader, self.now = device, PacketReader(), 0

    def say(self, number: int, argument: int | str | bytes | None = None) -> list[bytes]:
        return self.reader.feed(self.device.receive(command(number, argument), self.now))

    def run(self, seconds: float) -> list[Sip]:
        self.now += round(seconds * SECOND)
        return [decode_sip(each) for each in self.reader.feed(self.device.advance(self.now)) if is_sip(each)]

    def connect(self) -> "Client":
        for number in range(3):
            assert self.say(number)[0][0] == number
        self.say(Command.OPEN, 1)
        return self

    def drive(self, *commands: tuple[Command, int], seconds: float) -> Vec3:
        """Enable, command, and continue for a time with a pulse every half second; returns the position then."""
        self.say(Command.ENABLE, 1)
        for number, value in commands:
            self.say(number, value)
        for _ in range(round(seconds * 10)):
            self.run(0.1)
            self.say(Command.PULSE)
        return self.device.odometry
