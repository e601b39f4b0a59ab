"""The radio of a run: every link, what was lost and why."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis.link_budget import frame_report
from vcmvsp.cosim.analysis.links import Log
from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.report.link_counts import Links
from vcmvsp.cosim.report.page import Part, Rows, Words

LISTED = 150  # links


def link_table(links: Links) -> Sequence[Part]:
    """All links, those that delivered least first."""
    pairs = sorted(links.pairs, key=lambda pair: 2.0 if (ratio := links.ratio(*pair)) is None else ratio)
    if not pairs:
        return [Words("Nothing was sent.")]
    under_way = bool(links.under_way.any())
    rows: list[list[Any]] = []
    for a, b in pairs[:LISTED]:
        level = float(links.level_dbm[a, b])
        counts = [int(links.sent[a, b]), int(links.received[a, b])]
        counts += [int(links.under_way[a, b])] if under_way else []
        shown = None if np.isnan(level) else round(level, 1)
        rows.append([links.names[a], links.names[b], *counts, _percent(links.ratio(a, b)), shown, links.lost_to(a, b)])
    head = ["from", "to", "sent", "received", *(["under way"] if under_way else [])]
    head += ["delivered [%]", "mean level [dBm]", "lost to"]
    parts: list[Part] = [Rows(head, rows)]
    if len(pairs) > LISTED:
        parts.append(Words(f"And {len(pairs) - LISTED} links that delivered more: vcmvsp radio shows each."))
    return parts


def loss_table(links: Links, folder: Path) -> Sequence[Part]:
    """The causes of losses, the most frequent first, each with where it struck most and an example in words."""
    total = int(links.sent.sum())
    if not total:
        return []
    if not links.losses:
        return [Words("Nothing was lost.")]
    log = Log(folder)
    rows: list[list[Any]] = []
    for cause, lost in links.losses.items():
        a, b = np.unravel_index(int(lost.argmax()), lost.shape)
        pair = links.names[a], links.names[b]
        count = int(lost.sum())
        most = f"{pair[0]} to {pair[1]}: {int(lost[a, b])}"
        rows.append([cause, count, _percent(count / total), most, _example(log, pair, cause)])
    return [
        Words(f"Of {total} frames, counted at each receiver, {sum(row[1] for row in rows)} were lost."),
        Rows(["cause", "frames", "share [%]", "most on", "for example"], rows),
    ]


def _example(log: Log, pair: tuple[str, str], cause: str) -> str:
    """The first frame that a link lost so, and why."""
    frames = log.frames(pair)
    lost = frames.decided.where(np.array([word == cause for word in frames.decided.words("outcome")], np.bool_))
    try:
        report = frame_report(log, pair, str(lost["frame"].tolist()[0]), with_scenario=False)
    except VcmvspError:
        return ""
    why = report["why"].removeprefix("lost: ").removeprefix(f"{cause}: ")
    return f"frame {report['frame']} at {report['sent_s']:.3f} s: {why}"


def _percent(share: float | None) -> float | None:
    return None if share is None else round(100.0 * share, 1)
