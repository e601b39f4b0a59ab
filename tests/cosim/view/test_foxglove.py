"""The live stream for Foxglove, read by a client of the protocol that uses no code of the project."""

import asyncio
import contextlib
import json
import re
import struct
import sys
from pathlib import Path
from typing import Any

import pytest
import websockets
from mcap.reader import make_reader
from websockets.typing import Subprotocol

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import served
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.view.live.foxglove_server import FoxgloveServer, caution

pytest.importorskip("foxglove")
pytestmark = [pytest.mark.processes, pytest.mark.sockets]

PROTOCOL = Subprotocol("foxglove.sdk.v1")
HEAD = struct.Struct("<BIQ")  # of message data: opcode 1, subscription, time in ns
CLOCK = 2  # opcode of the server's time
PATIENCE_S = 60.0
SCENARIO = """
name = "streamed"
duration_s = 2.0
seed = 3

[physics]
kind = "kinematic"

[world]
kind = "boxes"
boxes = [{ center = [6, 6, 1], size = [3, 3, 2] }]

[agents]
period_s = 0.1

[vehicles]
kind = "kinematic"
sensors = { eye = { kind = "camera", rate_hz = 5.0, width = 64, height = 48 } }

[record]
sensors = ["eye"]

[[vehicle]]
name = "car1"
agent = { kind = "trajectory", path = "circle" }

[[vehicle]]
name = "car2"
pose = [0.0, -1.0, 0.0]
agent = { kind = "leader_follower", leader = "car1" }
"""
COMMAND = ("run", "streamed.toml", "--foxglove", "0", "--out", "out")
Message = tuple[str, int, bytes]  # topic, time, content


class Reader:
    """A client that subscribes to every advertised channel, until the server closes."""

    def __init__(self) -> None:
        self.info: dict[str, Any] = {}
        self.channels: dict[int, dict[str, Any]] = {}  # by number
        self.messages: list[Message] = []
        self.times: list[int] = []

    async def read(self, url: str, first: str | bytes | None) -> None:
        with contextlib.suppress(websockets.ConnectionClosed):
            await self._read(url, first)

    async def _read(self, url: str, first: str | bytes | None) -> None:
        async with websockets.connect(url, subprotocols=[PROTOCOL], max_size=None) as connection:
            if first is not None:
                await connection.send(first)
            async for message in connection:
                if isinstance(message, bytes):
                    self._take(message)
                    continue
                content = json.loads(message)
                if content["op"] == "serverInfo":
                    self.info = content
                elif content["op"] == "advertise":
                    new = {channel["id"]: channel for channel in content["channels"]}
                    self.channels |= new
                    await self._subscribe(connection, *new)
                elif content["op"] == "status" and (unknown := re.fullmatch(r"Unknown channel ID: (\d+)", content["message"])):
                    await asyncio.sleep(0.02)  # a channel is advertised shortly before it can be subscribed to
                    await self._subscribe(connection, *({int(unknown[1])} & self.channels.keys()))

    async def _subscribe(self, connection: websockets.ClientConnection, *numbers: int) -> None:
        subscriptions = [{"id": number, "channelId": number} for number in numbers]
        await connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def _take(self, message: bytes) -> None:
        if message[0] == CLOCK:
            self.times.append(struct.unpack_from("<Q", message, 1)[0])
        else:
            opcode, subscription, time_ns = HEAD.unpack_from(message)
            assert opcode == 1
            self.messages.append((self.channels[subscription]["topic"], time_ns, message[HEAD.size :]))


async def read(url: str, *first: str | bytes) -> list[Reader]:
    """Clients that have read until the end of the run: the first only subscribes, each other also sends one of ``first``."""
    readers = [Reader() for _ in range(1 + len(first))]
    async with asyncio.timeout(PATIENCE_S), asyncio.TaskGroup() as group:
        for reader, message in zip(readers, (None, *first), strict=True):
            group.create_task(reader.read(url, message))
    return readers


def recorded(path: Path) -> tuple[list[Message], dict[tuple[str, str], bytes]]:
    """The messages of a recording, and the schema of each topic and type."""
    with path.open("rb") as stream:
        rows = list(make_reader(stream).iter_messages(log_time_order=False))
    messages = [(channel.topic, message.log_time, message.data) for _, channel, message in rows]
    schemas = {(channel.topic, schema.name): schema.data for schema, channel, _ in rows if schema is not None}
    return messages, schemas


NONSENSE = (
    b"\xff" * 1000,
    "no JSON",
    '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 999}]}',
    '{"op": "advertise", "channels": [{"id": 1, "topic": "car1/command", "encoding": "json", "schemaName": ""}]}',
    '{"op": "setParameters", "parameters": [{"name": "radio.loss.probability", "value": 1.0}]}',
)


def test_a_client_gets_the_recorded_messages_and_changes_nothing(tmp_path: Path) -> None:
    """Other clients change nothing either: each sends an invalid or a forbidden message."""
    (tmp_path / "streamed.toml").write_text(SCENARIO)
    vcmvsp.run(tmp_path / "streamed.toml", out=tmp_path / "alone")
    with served(tmp_path, "Foxglove: ", *COMMAND) as (process, url):
        reader, *_ = asyncio.run(read(url, *NONSENSE))
        assert process.wait(PATIENCE_S) == 0
    assert url.startswith("ws://127.0.0.1:")
    assert (tmp_path / "out" / "run.mcap").read_bytes() == (tmp_path / "alone" / "run.mcap").read_bytes()

    assert reader.info["capabilities"] == ["time"]  # nothing can be sent to the run
    messages, schemas = recorded(tmp_path / "out" / "run.mcap")
    assert {(each["topic"], each["schemaName"]): each["schema"].encode() for each in reader.channels.values()} == schemas
    assert {(each["encoding"], each["schemaEncoding"]) for each in reader.channels.values()} == {("json", "jsonschema")}
    assert set(reader.messages) <= set(messages)
    topics = {topic for topic, *_ in messages} - {"log"}  # the last line of the log is written when the server closes
    assert {topic for topic, *_ in reader.messages} - {"log"} == topics  # also messages sent once, at the start
    joined_ns = min(time_ns for topic, time_ns, _ in reader.messages if topic == "/tf")
    later = [each for each in messages if each[1] > joined_ns and each[0] == "/tf"]
    assert len(later) >= 2
    assert set(later) <= set(reader.messages)  # none is missing afterwards
    assert reader.times == sorted(set(reader.times))


def test_a_used_port_is_one_line() -> None:
    with FoxgloveServer(port=0) as server:
        code, out, err = vcmvsp_command("run", "formation-circle", "--foxglove", str(server.port))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"127.0.0.1:{server.port}" in err


def test_without_the_sdk_its_installation_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    code, out, err = vcmvsp_command("run", "formation-circle", "--foxglove")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "pip install 'vcmvsp[foxglove]'" in err


def test_an_address_beyond_loopback_gives_a_caution() -> None:
    assert caution("127.0.0.1") == ""
    assert "neither token nor encryption" in caution("0.0.0.0")


def test_a_sink_needs_a_recording() -> None:
    with FoxgloveServer(port=0) as server, pytest.raises(UsageError, match="sink"):
        vcmvsp.run("formation-circle", mcap=False, sink=server)
