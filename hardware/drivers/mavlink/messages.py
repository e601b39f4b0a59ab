"""Messages to an autopilot other than set-points: heartbeat, commands, and telemetry requests."""

from vcmvsp.hardware.drivers.mavlink.autopilots import Autopilot
from vcmvsp.hardware.drivers.mavlink.codec import Message, Sender, mavlink

STATUS_HZ = 1.0  # of battery and landed state

_DATA_STREAMS = (mavlink.MAV_DATA_STREAM_POSITION, mavlink.MAV_DATA_STREAM_EXTRA1, mavlink.MAV_DATA_STREAM_EXTENDED_STATUS)


def heartbeat() -> Message:
    """Heartbeat of a ground station, once a second: an autopilot's data-link failsafe monitors it."""
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
    """Arm or disarm, never by force: the second parameter, which would override all checks, is zero."""
    return command(to, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, float(on), 0)


def intervals(to: Sender, position_message: str, hz: float) -> list[Message]:
    """Requests for position and attitude at this rate, and for slow status messages."""
    requests = ((position_message, hz), ("ATTITUDE", hz), ("SYS_STATUS", STATUS_HZ), ("EXTENDED_SYS_STATE", STATUS_HZ))
    return [
        command(to, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"), round(1e6 / rate))
        for name, rate in requests
    ]


def streams(to: Sender, hz: float) -> list[Message]:
    """Requests by REQUEST_DATA_STREAM, for an autopilot without message intervals."""
    rates = dict.fromkeys(_DATA_STREAMS, max(1, round(hz)))
    rates[mavlink.MAV_DATA_STREAM_EXTENDED_STATUS] = round(STATUS_HZ)
    request = mavlink.MAVLink_request_data_stream_message
    return [request(to.system, to.component, stream, rate, 1) for stream, rate in rates.items()]
