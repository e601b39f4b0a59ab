"""Agents of this process behind an encoded link: no process, and answers that a test may change."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence

import pytest

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.hosts.host_client import Desk
from vcmvsp.cosim.hosts.manager import Hosts
from vcmvsp.cosim.hosts.remote_host import RemoteHost


class MemoryLink:
    """A `SessionLink` within the process that encodes and decodes every message."""

    leaving = False

    def __init__(self, handle: Callable[[bytes], bytes]) -> None:
        self._handle = handle
        self._answers: list[bytes] = []

    def ask(self, question: bytes, deadline_s: float) -> None:
        self._answers.append(self._handle(question))

    def answer(self) -> bytes:
        return self._answers.pop(0)

    def look(self) -> bytes | None:
        return self._answers.pop(0) if self._answers else None

    def close(self) -> None:
        """There is no host process."""


@contextlib.contextmanager
def behind_the_wire(link: type[MemoryLink] = MemoryLink) -> Iterator[None]:
    """Within the block, in-process agents of runs are behind such a link."""

    def start(hosts: Hosts, specs: Mapping[str, Sequence[AgentSpec]], objects: object) -> None:
        desk = Desk(hosts._builders["inprocess"])
        hosts._stack.callback(desk.close)
        crew = hosts._crew(link(desk.handle), specs["inprocess"])
        hosts._add(RemoteHost("agents", [crew], [crew.build()]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hosts, "start", start)
        yield
