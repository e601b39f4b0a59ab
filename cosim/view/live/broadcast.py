"""A run's page on other machines: observers can look, but give no orders and request no readings of sensors."""

import time
from typing import Any, TypeVar

import msgspec

from vcmvsp.cosim.assembly.run import AssembledRun
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.hosts.event_publisher import Topics
from vcmvsp.cosim.hosts.observers import Observed, observed
from vcmvsp.cosim.hosts.page_publisher import PagePublisher
from vcmvsp.cosim.transport.key_names import PAGE_SCENERY, PAGE_UPDATE
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.feed import Feed, motions_of
from vcmvsp.cosim.view.live.session import Viewing
from vcmvsp.cosim.view.messages import Pace, PageUpdate, Scenery
from vcmvsp.cosim.view.scenery import crafts_of, scenery_of

T = TypeVar("T")
WHOLE_S = 1.0  # between two updates that leave nothing out
ASK_S = 0.5  # between two requests for the scenery of a run that has not begun

_sceneries: codec.Decoder[Scenery] = codec.Decoder(Scenery)


class Broadcast:
    """The run's side: publishes the page's updates while any observer shows them."""

    def __init__(self, run: AssembledRun, topics: Topics) -> None:
        scenery = scenery_of(run.scenario, run.source, world=run.world, live=True)
        scenery = msgspec.structs.replace(scenery, vehicles=crafts_of(run.scenario, run.source, infos=run.agents))
        self._publisher = PagePublisher(topics.session, codec.encode(scenery))
        self._feed = Feed(self._publisher, scenery, whole_s=WHOLE_S, **motions_of(run.world))
        self.on = self._feed.on

    def pace(self, speed: float | None) -> None:
        """Set the speed of the run, simulated seconds per second; None: as fast as possible."""
        self._feed.pace(Pace(speed=speed))

    def close(self, why: str) -> None:
        """Show how the run ended, and stop."""
        self._feed.close(why)
        self._publisher.close()


def show(endpoint: str, viewing: Viewing, **connection: Any) -> None:
    """Show the page of a run on this machine until the run ends; the page stays until ``viewing`` is closed.

    Args:
        endpoint: where the run listens.
        connection: as of `cosim.hosts.observers.observed`.

    Raises:
        UsageError: the run refuses this observer, has no page or an invalid one, or the page cannot be served here.
    """
    with observed(endpoint, **connection) as run:
        viewing.open(_scenery_of(run))
        update: PageUpdate | None = None
        for samples in run.samples([PAGE_UPDATE]):
            for sample in samples:
                payload = sample.payload.to_bytes()
                update = _decoded(protocol.shows, payload, run.endpoint)
                viewing.relay(payload)
    if update is not None and not update.pace.over:
        over = msgspec.structs.replace(update, pace=Pace(over="it is unreachable, or was killed"))
        viewing.relay(codec.encode(over))


def _decoded(decoder: codec.Decoder[T], payload: bytes, endpoint: str) -> T:
    try:
        return decoder.decode(payload)
    except ValueError as error:
        raise UsageError(f"the run at {endpoint} sent an invalid page, or one of another version: {error}") from error


def _scenery_of(run: Observed) -> Scenery:
    """The scenery of the run's page, once the run has begun."""
    while not run.presence.is_over():
        for reply in run.session.get(PAGE_SCENERY):
            if reply.ok is not None:
                return _decoded(_sceneries, reply.ok.payload.to_bytes(), run.endpoint)
        time.sleep(ASK_S)
    raise UsageError(f"the run at {run.endpoint} ended before it showed a page")
