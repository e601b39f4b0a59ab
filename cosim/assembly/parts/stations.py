"""Stop and heartbeat of the robots that are driven on this machine; imports little, since a stop must not wait."""

from vcmvsp.hardware.station.emergency_stop import LONGEST_NAME, StationAnswer, StopCaller

__all__ = ["LONGEST_NAME", "StationAnswer", "StopCaller"]
