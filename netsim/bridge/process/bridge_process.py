"""The bridge process: opens all doors, gives the run what comes in through them, and delivers what the run says is due.

It ends when it is told to, and when the link to the run ends, however that came about. The run takes one batch of datagrams at
a time and says when it has: until then they wait here, in a store that is bounded for each vehicle
(`netsim.bridge.process.datagram_store`).
"""

import asyncio
import contextlib
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import ScenarioError, place_of, words_of
from vcmvsp.cosim.processes.local_link import Link
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge.gateways.base import Door, DoorError
from vcmvsp.netsim.bridge.process import messages
from vcmvsp.netsim.bridge.process.datagram_store import Store
from vcmvsp.netsim.bridge.process.gateway_context import OpenHall
from vcmvsp.netsim.bridge.process.pacer import Delivery, Pacer

OPENING_S = 60.0  # from the start to being told what to open
CLOSE_S = 3.0  # for a door to close, or for last words,
VEHICLE_S = 0.02  # and more for each vehicle
RETRY_S = 0.001  # between two attempts to say something to a run that does not read
REPORT_S = 0.05  # between two reports of what was delivered and counted
WENT_MOST = 4000  # deliveries that are not left to wait for that
COUNTED_MOST = 100  # vehicles in a message


class Process:
    """What the process does between its first word and its last."""

    def __init__(self, link: Link, loop: asyncio.AbstractEventLoop, *, wary: bool = False) -> None:
        self._link, self._loop, self._wary = link, loop, wary
        self._over: asyncio.Future[str] = loop.create_future()  # why it ends; empty: it is to
        self._doors: list[tuple[str, Door]] = []
        self._begun: list[tuple[str, Door]] = []  # those that are open, or were to be
        self._unsaid: deque[bytes] = deque()
        self._given = 0  # datagrams that the run has been told of
        self._batch = False  # whether it has still to take those of the last batch
        self._flushing = False
        self._due = 0  # deliveries that it has told of
        self._went: list[tuple[int, int]] = []
        self._asked = False

    async def serve(self) -> int:
        """All of it; the exit code."""
        try:
            problem = await self._go_through(self._opening())
        except (DoorError, ScenarioError) as error:
            problem = str(error)
        except Exception as error:
            problem = _words(error)
        if problem:
            self._say(messages.Failed(problem=problem))
        self._say_the_rest()
        return 3 if problem else 0

    async def _go_through(self, opening: messages.Opening) -> str:
        """From opening the doors to closing them; why it ends."""
        self._loop.set_exception_handler(self._on_exception)
        self._loop.add_signal_handler(signal.SIGTERM, self._end, "it was told to end (SIGTERM)")
        self._loop.add_reader(self._link.fileno(), self._hear)
        try:
            await self._open(opening)
            return await self._over
        finally:
            await self._close(CLOSE_S + VEHICLE_S * len(opening.vehicles))
            self._tell_went()
            self._tell_counts()

    # The beginning

    def _opening(self) -> messages.Opening:
        self._link.wait(OPENING_S)
        received = self._link.receive()
        if not received or not isinstance(opening := messages.downs.decode(received[0]), messages.Opening):
            raise DoorError("nobody told the bridge's process what to open: it is started by runs")
        if self._wary:
            _check(opening)
        self._store = Store(len(opening.vehicles), payloads=opening.payloads)
        self._hall = OpenHall(
            opening.run, opening.vehicles, self._loop, self._store, news=self._on_news, wanted=self._on_wanted
        )
        self._pacer = Pacer(self._loop, self._deliver)
        self._payloads = opening.payloads
        for message in received[1:]:
            self._obey(messages.downs.decode(message))
        return opening

    async def _open(self, opening: messages.Opening) -> None:
        """Open all doors, unless the run ends before."""
        folder = Path(opening.folder)
        with registry.looking_in(folder):
            for spec in opening.doors:
                self._doors.append((spec.name, _built(spec, folder)))
        lines: list[str] = []
        for name, door in self._doors:
            self._begun.append((name, door))
            task = asyncio.ensure_future(door.open(self._hall))
            either: list[asyncio.Future[Any]] = [task, self._over]
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if self._over.done():
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, Exception):
                    await task
                return
            try:
                lines += [f"bridge.{name}: {line}" for line in task.result()]
            except DoorError as error:
                raise DoorError(f"bridge.{name}: {error}") from error
            except Exception as error:
                raise DoorError(f"bridge.{name}: {_words(error)}") from error
        self._say(messages.Ready(lines=tuple(lines)))
        self._report()

    # From programs to the run

    def _on_news(self) -> None:
        if not self._batch and not self._flushing:
            self._flushing = True
            self._loop.call_soon(self._flush)  # behind whatever else comes in this turn

    def _on_wanted(self) -> None:
        if not self._asked:
            self._asked = True
            self._say(messages.Asked())

    def _flush(self) -> None:
        """Give the run what is new, unless it has not taken yet what it was given."""
        self._flushing = False
        if self._batch or not (numbers := self._store.batch()):
            return
        self._batch = True
        self._given += len(numbers)
        store, doors = self._store, {id(door): row for row, (_, door) in enumerate(self._doors)}
        rows = [
            (number, doors[id(kept.door)], kept.sender, kept.to, len(kept.payload), kept.came_ns)
            for number in numbers
            for kept in (store[number],)
        ]
        number, door, sender, to, size, came_ns = np.array(rows, np.int64).T
        came = messages.Came(
            number=number,
            door=door.astype(np.int32),
            sender=sender.astype(np.int32),
            to=to.astype(np.int32),
            size_bytes=size,
            came_ns=came_ns,
            payloads=tuple(store[each].payload for each in numbers) if self._payloads else (),
        )
        self._say(came)

    def _say(self, message: messages.Up) -> None:
        self._unsaid.append(encode(message))
        if len(self._unsaid) == 1:
            self._go_on_saying()

    def _go_on_saying(self) -> None:
        while self._unsaid:
            try:
                went = self._link.send(self._unsaid[0])
            except ValueError:
                self._unsaid.popleft()  # or nothing could be said any more, not even this
                raise
            if not went:
                if not self._over.done():
                    self._loop.call_later(RETRY_S, self._go_on_saying)
                return
            self._unsaid.popleft()

    # From the run to programs

    def _hear(self) -> None:
        for message in self._link.receive():
            self._obey(messages.downs.decode(message))
        if self._link.ended:
            self._end("")

    def _obey(self, message: messages.Down) -> None:
        if isinstance(message, messages.Due):
            self._on_due(message)
        elif isinstance(message, messages.Spoken):
            self._pacer.put(Delivery(message.at_ns, self._store.speak(message.sender, message.payload), -1, message.receiver))
            self._pacer.arm()
        elif isinstance(message, messages.Levels):
            self._hall.tell_levels(message.first, message.dbm)
        elif isinstance(message, messages.Leave):
            self._end("")

    def _on_due(self, due: messages.Due) -> None:
        store, put, row = self._store, self._pacer.put, self._due
        for number, receiver, at_ns in zip(due.number.tolist(), due.receiver.tolist(), due.at_ns.tolist(), strict=True):
            store.due(number)
            put(Delivery(at_ns, number, row, receiver))
            row += 1
        self._due = row
        for number in due.settled.tolist():
            kept = store.settle(number)
            if kept is not None and kept.door is not None and (lost := getattr(kept.door, "lost", None)) is not None:
                with self._blamed(kept.door):
                    lost(kept.sender, kept.to, kept.payload)
        if self._batch and due.taken >= self._given:
            self._batch = False
            self._flush()
        self._pacer.arm()

    def _deliver(self, delivery: Delivery) -> None:
        kept = self._store[delivery.number]
        doors = [door for _, door in self._doors] if kept.door is None else [kept.door]
        try:
            for door in doors:
                with self._blamed(door):
                    door.deliver(kept.sender, delivery.receiver, kept.payload)
        finally:
            self._store.left(delivery.number)
        if delivery.row >= 0:
            self._went.append((delivery.row, time.monotonic_ns()))
            if len(self._went) >= WENT_MOST:
                self._tell_went()

    @contextlib.contextmanager
    def _blamed(self, door: Door) -> Iterator[None]:
        """Whatever a door lets out here ends the bridge, with its name."""
        try:
            yield
        except Exception as error:
            name = next(name for name, each in self._doors if each is door)
            self._end(f"bridge.{name}: {_words(error)}")

    def _tell_went(self) -> None:
        if self._went:
            due, went_ns = np.array(self._went, np.int64).T
            self._went.clear()
            self._say(messages.Went(due=due, went_ns=went_ns))

    def _report(self) -> None:
        """Say again and again what was delivered and counted, to a run that reads: what it is told later says more."""
        if not self._unsaid:
            self._tell_went()
            self._tell_counts()
        self._loop.call_later(REPORT_S, self._report)

    def _tell_counts(self) -> None:
        counts, changed = self._hall.counts, list(self._hall.counted)
        self._hall.counted.clear()
        for first in range(0, len(changed), COUNTED_MOST):
            self._say(messages.Counted(counts={name: dict(counts[name]) for name in changed[first : first + COUNTED_MOST]}))

    # The end

    def _end(self, why: str) -> None:
        if not self._over.done():
            self._over.set_result(why)

    def _on_exception(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """A door let an exception out: what befalls a connection is told and nothing more, all else ends the bridge."""
        error = context.get("exception")
        if isinstance(error, OSError) or error is None:
            sys.stderr.write(f"bridge: {context.get('message', 'trouble')}: {error}\n")
        else:
            self._end(_words(error))

    async def _close(self, seconds: float) -> None:
        for name, door in self._begun:
            try:
                await asyncio.wait_for(door.close(), seconds)
            except Exception as error:  # others are to be closed, too
                sys.stderr.write(f"bridge: closing bridge.{name}: {_words(error)}\n")

    def _say_the_rest(self) -> None:
        """Say what is left to say, as long as somebody listens."""
        until = time.monotonic() + CLOSE_S
        while self._unsaid and time.monotonic() < until and not self._link.ended:
            self._go_on_saying()
            if self._unsaid:
                self._link.receive()
                time.sleep(RETRY_S)
        self._link.close()


def _check(opening: messages.Opening) -> None:
    """Refuse code that a run names, and names that lead elsewhere as files, to a process with root's rights."""
    for spec in opening.doors:
        if ":" in spec.kind:
            raise DoorError(
                f"bridge.{spec.name}: {spec.kind} would have root's rights: with sudo, only built-in doors are opened"
            )
    for name in (opening.run, *opening.vehicles):
        if "/" in name or name in (".", ".."):
            raise DoorError(f"'{name}': no network can have such a name")


def _built(spec: messages.DoorSpec, folder: Path) -> Door:
    kind = registry.find("door", spec.kind, folder=folder, key=f"bridge.{spec.name}.kind")
    door: Door = binding.call(kind, spec.params, key=f"bridge.{spec.name}")
    return door


def _words(error: BaseException) -> str:
    return f"{words_of(error)}{place_of(error)}"
