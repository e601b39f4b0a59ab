"""Zenoh without us: a hub and its clients exchange the same bytes, and do nothing with them.

A declared publisher each way: of the ways that Zenoh's Python API offers the quickest here (a query and its reply takes a third
longer). Direct callbacks, which hand over to a queue.
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


def hub(wanted: Options) -> None:
    """Ask all clients before any is awaited."""
    pace, groups = Pace(wanted), wanted.processes
    question = bytes(wanted.asked * wanted.agents // groups)
    answers: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    admin = {"enabled": True, "permissions": {"read": True, "write": False}}
    with opened(mode="router", listen={"endpoints": ["tcp/127.0.0.1:0"]}, adminspace=admin) as session:
        replies = [each.ok for each in session.get(f"@/{session.zid()}/router") if each.ok]
        endpoint = json.loads(replies[0].payload.to_string())["locators"][0]
        session.declare_subscriber("bench/*/answer", Callback(answers.put, indirect=False))
        asks = [session.declare_publisher(f"bench/{n}/ask", congestion_control=BLOCK) for n in range(groups)]
        common = ["--answered", str(wanted.answered * wanted.agents // groups)]
        children = [child("bench.peers.bare", "--at", f"{endpoint} bench/{n}", *common) for n in range(groups)]
        for _ in asks:
            answers.get(timeout=WAIT_S)
        while pace.step():
            for ask in asks:
                ask.put(question)
            for _ in asks:
                answers.get(timeout=WAIT_S).payload.to_bytes()
        for each in children:
            each.communicate()


def leave(questions: "queue.SimpleQueue[zenoh.Sample | None]") -> None:
    """No more questions when the hub is gone."""
    sys.stdin.buffer.read()
    questions.put(None)


def client(wanted: Options) -> None:
    """Answer until nobody asks any more; an answer to nobody says that it is there."""
    endpoint, _, key = wanted.at.partition(" ")
    answer = bytes(wanted.answered)
    questions: queue.SimpleQueue[zenoh.Sample | None] = queue.SimpleQueue()
    with opened(mode="client", connect={"endpoints": [endpoint]}, listen={"endpoints": []}) as session:
        session.declare_subscriber(f"{key}/ask", Callback(questions.put, indirect=False))
        answers = session.declare_publisher(f"{key}/answer", congestion_control=BLOCK)
        threading.Thread(target=leave, args=(questions,), daemon=True).start()
        answers.put(answer)
        while question := questions.get():
            question.payload.to_bytes()
            answers.put(answer)


if __name__ == "__main__":
    given = options()
    (client if given.at else hub)(given)
