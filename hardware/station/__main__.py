"""Process of a station: ``python -P -m vcmvsp.hardware.station FD``, FD is the inherited end of the link to its run.

Its cycle has a constant rate, on deadlines that do not drift. When the run ends, for any reason, the robot is stopped within
one cycle. Ctrl-C (SIGINT) is ignored: the run handles it. SIGTERM stops the robot and ends the station.
"""

import contextlib
import gc
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import ScenarioError, place_of, words_of
from vcmvsp.cosim.processes.child_process import LocalLink
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.drivers.base import Driver, DriverError, within
from vcmvsp.hardware.station import messages
from vcmvsp.hardware.station.controller import StationController
from vcmvsp.hardware.station.emergency_stop import StationAnswer, StopListener
from vcmvsp.hardware.station.messages import OPERATOR_STOP, PartSpec, StationMission, StationOrder, StationReport, missions

if TYPE_CHECKING:
    from vcmvsp.hardware.localisation.source import Localisation

MISSION_S = 10.0  # from the start to the mission
HANG_S = 3.0  # for a cycle, which takes about a millisecond
GRACE_S = 2.0  # for drivers, beyond their own deadlines
OPEN_S = 10.0  # for a localisation, which has no deadline of its own
STAND_S = 5.0  # for a robot to stop
NICE = -5  # where the system allows it
FAILED = 3  # exit code


class StationProcess:
    """The process around a `StationController`."""

    def __init__(self, link: LocalLink) -> None:
        self._link = link
        self._controller: StationController | None = None
        self._stop_listener: StopListener | None = None
        self._driver: Driver | None = None
        self._localisation: Localisation | None = None
        self._order: tuple[StationOrder, int] | None = None  # newest order that no cycle has used, and its arrival
        self._ending = ""  # reason to end
        self._leaves = False  # the run has ended
        self._early = ""  # reason to stop before the robot is open
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, self._on_stop_signal)

    def serve(self) -> int:
        """Run until the end; the exit code."""
        failed = advice = ""
        try:
            mission = self._mission()
            self._open(mission)
            self._turn(mission)
        except DriverError as error:
            failed, advice = f"{error.device}: {error.happened}", error.advice
        except ScenarioError as error:
            failed, advice = str(error), "correct the scenario"
        except Exception as error:
            failed, advice = f"{words_of(error)}{place_of(error)}", "report this to the author of the driver"
        finally:
            halted = self._controller.halted if self._controller is not None else ""
            for problem in self._close(failed or halted or self._ending or "the station ends"):
                failed, advice = failed or problem, advice or "secure the robot"
        if self._leaves and self._controller is None:
            failed = ""  # the run ended before the robot was open
        elif not failed and not self._leaves:
            failed, advice = self._ending, "start the run again"
        with contextlib.suppress(Exception):  # the run may have ended
            report, now_ns = StationReport(number=1, time_ns=0, failed=failed, advice=advice), time.monotonic_ns()
            if self._controller is not None:
                report = self._controller.last_words(now_ns, failed, advice)
            self._link.send(encode(msgspec.structs.replace(report, time_ns=now_ns)))
        return FAILED if failed else 0

    def _mission(self) -> StationMission:
        self._link.wait(MISSION_S)
        messages = self._link.receive()
        if not messages:
            raise DriverError("station", "the station received no instructions", "stations are started by runs")
        mission = missions.decode(messages[0])
        self._vehicle, self._run = mission.vehicle, mission.run
        for message in messages[1:]:
            self._obey(message)
        return mission

    def _open(self, mission: StationMission) -> None:
        vehicle = self._vehicle
        self._stop_listener = StopListener(vehicle)
        localisation: Localisation | None = None
        with within(OPEN_S, vehicle, "building its driver", self._reason_to_abort):
            driver: Driver = _build_part(mission.driver, mission)
            if mission.localisation is not None:
                localisation = _build_part(mission.localisation, mission)
            controller = StationController(mission, driver, localisation, time.monotonic_ns)
        self._driver = driver
        with within(driver.open_deadline_s + GRACE_S, driver.device, "opening it", self._reason_to_abort):
            driver.open(mission.start)
        if localisation is not None:
            self._localisation = localisation
            with within(OPEN_S, localisation.device, "opening it", self._reason_to_abort):
                localisation.open()
        self._controller = controller
        self._halt(self._early)

    def _reason_to_abort(self) -> str:
        """Reason to abort connecting the robot; empty: continue."""
        self._hear_run()
        self._hear_operator()
        return self._ending or self._early or ("its run is over" if self._leaves else "")

    def _on_stop_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._ending = "its station was told to end (SIGTERM)"

    def _turn(self, mission: StationMission) -> None:
        controller = self._controller
        assert controller is not None  # noqa: S101  it is open
        gc.collect()
        gc.freeze()  # present objects are not looked at again
        with contextlib.suppress(OSError):
            os.nice(NICE)
        period_ns = round(SECOND_NS / mission.rate_hz)
        due_ns = time.monotonic_ns()
        leave_by_ns: int | None = None
        with within(HANG_S, self._vehicle, "a turn of its station") as turned:
            while not self._ending:
                turned()
                now_ns = time.monotonic_ns()
                late_ns = now_ns - due_ns
                order, arrival_ns = self._order or (None, None)
                self._order = None
                report = controller.turn(now_ns, order, arrival_ns=arrival_ns, late_s=late_ns / SECOND_NS)
                if self._link.send(encode(report)):
                    controller.delivered()
                if self._leaves:
                    leave_by_ns = leave_by_ns or now_ns + round(STAND_S * SECOND_NS)
                    if controller.stands or now_ns >= leave_by_ns:
                        return
                due_ns += period_ns * (1 + late_ns // period_ns)  # missed cycles are skipped
                self._wait(due_ns)

    def _wait(self, until_ns: int) -> None:
        """Process messages until the next cycle; at least once, also if it is late."""
        assert self._stop_listener is not None  # noqa: S101  it is open
        run, operator = self._link.fileno(), self._stop_listener.fileno()  # the first may be any number: it was inherited
        remaining_s = 1.0
        while not self._ending and remaining_s > 0.0:
            remaining_s = max(0.0, (until_ns - time.monotonic_ns()) / SECOND_NS)
            ready = readable((run, operator), remaining_s)
            if run in ready:
                self._hear_run()
            if operator in ready:
                self._hear_operator()

    def _hear_run(self) -> None:
        for message in self._link.receive():
            self._obey(message)
        if self._link.ended and not self._ending:
            self._ending = "its run has ended without notice"
            self._halt(self._ending)

    def _obey(self, message: bytes) -> None:
        """Take an order: the newest counts, but no stop is lost."""
        try:
            order = messages.orders.decode(message)
        except ValueError as error:
            raise DriverError(self._vehicle, f"the run sent an invalid order ({error})", "report this error") from None
        self._halt(order.stop)
        if order.leave:
            self._leaves = True
            self._halt("the run is over")
        self._order = order, time.monotonic_ns()

    def _halt(self, cause: str) -> None:
        if self._controller is None:
            self._early = self._early or cause
        elif cause:
            self._controller.halt(cause)

    def _hear_operator(self) -> str:
        """Obey the operator, also while the robot is connected (which is aborted: it may be taking off) or released."""
        if (listener := self._stop_listener) is None:
            return ""
        for verb, address in listener.hear():
            if verb == "stop":
                self._halt(OPERATOR_STOP)
            if verb == "alive":
                if self._controller is not None:
                    self._controller.operator_heard()
                continue
            cause = self._early if self._controller is None else self._controller.halted
            state: Literal["stopped", "driving"] = "stopped" if cause else "driving"
            listener.answer(
                address, StationAnswer(vehicle=self._vehicle, run=self._run, pid=os.getpid(), state=state, cause=cause)
            )
        return ""

    def _close(self, cause: str) -> list[str]:
        """Stop the robot and release everything; problems on the way."""
        problems = []

        def tried(action: Callable[[], None], seconds: float, doing: str) -> None:
            try:
                with within(seconds, self._vehicle, doing, self._hear_operator):
                    action()
            except Exception as error:
                problems.append(f"{doing}: {error}")

        if (driver := self._driver) is not None:
            tried(lambda: driver.stop(cause), GRACE_S, "stopping it")
            tried(driver.close, driver.close_deadline_s + GRACE_S, "closing it")
        if self._localisation is not None:
            tried(self._localisation.close, OPEN_S, "closing its localisation")
        if self._stop_listener is not None:
            self._stop_listener.close()
        return problems


def _build_part(part: PartSpec, mission: StationMission) -> Any:
    """Object that a scenario names, with its parameters; it gets vehicle and folder if it takes them."""
    folder = Path(mission.folder)
    with registry.looking_in(folder):
        kind = registry.find(part.group, part.kind, folder=folder, key=f"{part.group}.kind")
        accepted = binding.parameters(kind)
        offered = {"vehicle": mission.vehicle, "folder": mission.folder}
        return binding.call(kind, part.params, key=part.group, arguments={n: v for n, v in offered.items() if n in accepted})


if __name__ == "__main__":
    code = StationProcess(LocalLink(socket.socket(fileno=int(sys.argv[1])))).serve()
    sys.stderr.flush()
    os._exit(code)  # a driver's thread that hangs must not keep the process alive
