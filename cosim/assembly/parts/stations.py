"""Stop and heartbeat of the robots driven from this machine; few imports, so that a stop is not delayed."""

from vcmvsp.hardware.station.emergency_stop import LONGEST_NAME, StationAnswer, StopCaller
