"""What is said to an autopilot besides set-points: our heartbeat, commands, and which telemetry is wanted how often."""

from vcmvsp.hardware.drivers.mavlink.autopilots import Autopilot
from vcmvsp.hardware.drivers.mavlink.codec import Message, Sender, mavlink

STATUS_HZ = 1.0  # of the battery, and of whether it stands on the ground

_DATA_STREAMS = (mavlink.MAV_DATA_STREAM_POSITION, mavlink.MAV_DATA_STREAM_EXTRA1, mavlink.MAV_DATA_STREAM_EXTENDED_STATUS)


def heartbeat() -> Message:
    """Ours, once a second: a ground station's, so that an autopilot's data-link failsafe watches over us."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )


def command(to: Sender, number: int, *parameters: float) -> Message:
    """COMMAND_LONG; parameters that are left out are zero."""
    padded = (*parameters, *(0.0,) * (7 - len(parameters)))
    return mavlink.MAVLink_command_long_message(to.system, to.component, number, 0, *padded)


def switch(to: Sender, autopilot: Autopilot, mode: str) -> Message:
    """Change to a mode."""
    return command(to, mavlink.MAV_CMD_DO_SET_MODE, *autopilot.switch_to(mode))


def arm(to: Sender, *, on: bool) -> Message:
    """Never by force: the second parameter, which would overrule all checks, stays zero."""
    return command(to, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, float(on), 0)


def intervals(to: Sender, position_message: str, hz: float) -> list[Message]:
    """Ask for position and attitude so many times a second, and for what changes slowly."""
    requests = ((position_message, hz), ("ATTITUDE", hz), ("SYS_STATUS", STATUS_HZ), ("EXTENDED_SYS_STATE", STATUS_HZ))
    return [
        command(to, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"), round(1e6 / rate))
        for name, rate in requests
    ]


def streams(to: Sender, hz: float) -> list[Message]:
    """The same in the old way, for an autopilot that knows no other."""
    rates = [max(1, round(hz if each != mavlink.MAV_DATA_STREAM_EXTENDED_STATUS else STATUS_HZ)) for each in _DATA_STREAMS]
    return [
        mavlink.MAVLink_request_data_stream_message(to.system, to.component, stream, rate, 1)
        for stream, rate in zip(_DATA_STREAMS, rates, strict=True)
    ]
