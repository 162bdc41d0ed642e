"""Times of logged messages: the stamps in their headers, laid on log time; log time where stamps cannot be used.

A publisher stamps a message when it measures, the recorder logs it when it arrives. Stamps may come from a clock of
another epoch, so only their offset from log time counts: the least median delay of the topics of one clock. Topics
that arrive later than that were delayed on their way, and their stamps undo it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from real2sim.configuration import validated
from real2sim.recording.formats.recordings import Finding, StampDelay

if TYPE_CHECKING:
    from real2sim.settings import IngestRobotLogStampsSettings

_NS_PER_S = 10**9
_LONGEST_S = 1 << 33  # seconds of a stamp that fit into 64 bits as nanoseconds; beyond, the stamp is none
_SPREAD = (5, 95)  # percentiles between which the spread of delays is measured


@dataclass
class StampedTopic:
    """Times of the messages of one topic [ns], in the order of the file; a stamp of 0 is none.

    ``counted`` (n,) marks the messages that the log's clock is judged by.
    """

    name: str
    logged_ns: np.ndarray
    stamp_ns: np.ndarray
    counted: np.ndarray


@cache
def default_settings() -> IngestRobotLogStampsSettings:
    """Return the slice ``ingest.robot_log.stamps`` of a configuration that sets nothing."""
    settings = validated({}, "config", Path("defaults"))["ingest"]["robot_log"]["stamps"]
    return cast("IngestRobotLogStampsSettings", settings)


def stamp_ns(seconds: np.ndarray, nanoseconds: np.ndarray) -> np.ndarray:
    """Return stamps (n,) [ns] of their two fields, 0 where they are no time."""
    fits = (seconds >= 0) & (seconds < _LONGEST_S) & (nanoseconds >= 0) & (nanoseconds < _LONGEST_S)
    whole = np.where(fits, seconds, 0).astype(np.int64) * _NS_PER_S
    return whole + np.where(fits, nanoseconds, 0).astype(np.int64)


def choose_times(
    path: Path, topics: list[StampedTopic], settings: IngestRobotLogStampsSettings, findings: list[Finding]
) -> tuple[dict[str, np.ndarray], dict[str, StampDelay]]:
    """Return times (n,) [ns, log time] of the messages by topic, and the delays of the topics with stamps.

    Stamps plus the offset of their clock where they are usable. One stamp that is far from the others is replaced by
    log time less the median delay. Topics whose stamps are missing, or do not keep pace with log time, keep log time.
    """
    same_clock = round(settings["same_clock_s"] * _NS_PER_S)
    times = {topic.name: topic.logged_ns for topic in topics}
    usable = {topic.name: topic for topic in topics if _usable(path, topic, settings, findings)}
    medians = {name: _median(topic) for name, topic in usable.items()}
    delays = {}
    for name, topic in usable.items():
        median = medians[name]
        offset = min(other for other in medians.values() if abs(other - median) <= same_clock)
        delay = topic.logged_ns - topic.stamp_ns - median
        near = (np.abs(delay) <= same_clock) & (topic.stamp_ns > 0)
        times[name] = np.where(near, topic.stamp_ns + offset, topic.logged_ns - (median - offset))
        low, high = np.percentile(delay[near & topic.counted], _SPREAD)
        other_clock = abs(offset) > same_clock
        delays[name] = StampDelay(
            median / _NS_PER_S, (median - offset) / _NS_PER_S, float(high - low) / _NS_PER_S, other_clock
        )
        _report(path, topic, near, times[name], delays[name], findings)
    return times, delays


def large_delays(
    path: Path, delays: Mapping[str, StampDelay], settings: IngestRobotLogStampsSettings
) -> list[Finding]:
    """Return a warning for each topic whose delay from stamp to log time is large, or varies much."""
    out = []
    for topic, delay in delays.items():
        median = delay.beyond_clock_s if delay.other_clock else delay.median_s
        if max(abs(median), delay.spread_s) > settings["delay_warn_s"]:
            against = "the first topic of its clock" if delay.other_clock else "its stamps"
            message = (
                f"logged {1e3 * median:.1f} ms after {against} (median), spread {1e3 * delay.spread_s:.1f} ms"
            )
            action = "stamps are used; /sync has none, its time is the log's"
            out.append(Finding("stamp_delay", "warning", path.name, topic, message, action))
    return out


def _median(topic: StampedTopic) -> int:
    """Return the median delay [ns] of the messages with a stamp."""
    delay = (topic.logged_ns - topic.stamp_ns)[topic.counted & (topic.stamp_ns > 0)]
    return int(delay[0]) + int(np.median(delay - delay[0]))


def _usable(
    path: Path, topic: StampedTopic, settings: IngestRobotLogStampsSettings, findings: list[Finding]
) -> bool:
    """Return whether nearly all messages have a stamp that keeps pace with log time; report where not."""
    counted = topic.counted
    if not counted.any():
        return False
    if not (topic.stamp_ns[counted] > 0).any():
        message, action = "no message has a stamp", "log time is used"
        findings.append(Finding("stamps_absent", "info", path.name, topic.name, message, action))
        return False
    delay = np.abs(topic.logged_ns - topic.stamp_ns - _median(topic)) / _NS_PER_S
    share = float(((delay <= settings["same_clock_s"]) & (topic.stamp_ns > 0))[counted].mean())
    if share >= settings["usable_share"]:
        return True
    message = f"only {100 * share:.0f} % of the stamps keep pace with log time within {settings['same_clock_s']:g} s"
    action = "log time is used; let the publisher stamp its messages"
    findings.append(Finding("stamps_unusable", "warning", path.name, topic.name, message, action))
    return False


def _report(
    path: Path,
    topic: StampedTopic,
    near: np.ndarray,
    times: np.ndarray,
    delay: StampDelay,
    findings: list[Finding],
) -> None:
    def note(code: str, severity: str, message: str, action: str) -> None:
        findings.append(Finding(code, severity, path.name, topic.name, message, action))

    far, back = int((~near & topic.counted).sum()), int((np.diff(times[topic.counted]) < 0).sum())
    if far:
        note(
            "stamp_far",
            "warning",
            f"{far} stamps far from the others",
            "log time less the median delay is used",
        )
    if back:
        note("stamp_order", "info", f"stamps step back in time {back} times", "ordered by stamp")
    if delay.other_clock:
        message = f"stamps of another clock, {delay.median_s:.6g} s before log time"
        note(
            "stamps_other_clock", "info", message, "laid on log time by the least median delay of its topics"
        )
