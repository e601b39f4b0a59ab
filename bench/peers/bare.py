"""Zenoh alone: a hub and its clients exchange the same bytes.

``--way query``: a query and its reply, Zenoh's own request and answer (a declared queryable; all are queried, by `Session.get`
with its default handler, before any is awaited). ``--way publish``: a declared publisher each way, as in our own transport.
Direct callbacks, which put the data into a queue.
"""

import json
import queue
import sys
import threading
from typing import Any

import zenoh
from zenoh.handlers import Callback

from bench.peers.pace import Options, Pace, child, options

CONFIG = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}},
}
BLOCK = zenoh.CongestionControl.BLOCK
WAIT_S = 60.0


def opened(**more: Any) -> zenoh.Session:
    """A session."""
    return zenoh.open(zenoh.Config.from_json5(json.dumps({**CONFIG, **more})))


def hub(settings: Options) -> None:
    """Query all clients before any is awaited."""
    pace, groups = Pace(settings), settings.processes
    question = bytes(settings.asked * settings.agents // groups)
    answers: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    admin = {"enabled": True, "permissions": {"read": True, "write": False}}
    with opened(mode="router", listen={"endpoints": ["tcp/127.0.0.1:0"]}, adminspace=admin) as session:
        replies = [each.ok for each in session.get(f"@/{session.zid()}/router") if each.ok]
        endpoint = json.loads(replies[0].payload.to_string())["locators"][0]
        session.declare_subscriber("bench/*/answer", Callback(answers.put, indirect=False))
        asks = [session.declare_publisher(f"bench/{n}/ask", congestion_control=BLOCK) for n in range(groups)]
        common = ["--way", settings.way, "--answered", str(settings.answered * settings.agents // groups)]
        children = [child("bench.peers.bare", "--at", f"{endpoint} bench/{n}", *common) for n in range(groups)]
        for _ in asks:
            answers.get(timeout=WAIT_S)
        while pace.step():
            if settings.way == "query":
                for handler in [session.get(ask.key_expr, payload=question, timeout=WAIT_S) for ask in asks]:
                    (reply,) = handler
                    assert reply.ok
                    reply.ok.payload.to_bytes()
            else:
                for ask in asks:
                    ask.put(question)
                for _ in asks:
                    answers.get(timeout=WAIT_S).payload.to_bytes()
        for each in children:
            each.communicate()


def leave(questions: "queue.SimpleQueue[zenoh.Sample | zenoh.Query | None]") -> None:
    """End the client when the hub is gone."""
    sys.stdin.buffer.read()
    questions.put(None)


def client(settings: Options) -> None:
    """Answer until the hub ends; the first, unsolicited answer announces the client."""
    endpoint, _, key = settings.at.partition(" ")
    answer = bytes(settings.answered)
    questions: queue.SimpleQueue[zenoh.Sample | zenoh.Query | None] = queue.SimpleQueue()
    with opened(mode="client", connect={"endpoints": [endpoint]}, listen={"endpoints": []}) as session:
        declare = session.declare_queryable if settings.way == "query" else session.declare_subscriber
        declare(f"{key}/ask", Callback(questions.put, indirect=False))
        answers = session.declare_publisher(f"{key}/answer", congestion_control=BLOCK)
        threading.Thread(target=leave, args=(questions,), daemon=True).start()
        answers.put(answer)
        while question := questions.get():
            bytes(question.payload or b"")
            if isinstance(question, zenoh.Query):
                with question:
                    question.reply(question.key_expr, answer)
            else:
                answers.put(answer)


if __name__ == "__main__":
    settings = options()
    (client if settings.at else hub)(settings)
