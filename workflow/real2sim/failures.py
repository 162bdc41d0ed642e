"""The last lines of a run that failed: what failed, why, and where its log is."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

# By this line a stage says in its log why it ended
FAILED = "error in stage"


@dataclass(frozen=True)
class FailedJob:
    """A job, or a group of jobs, that the workflow engine gave up: rules, its reason if it has one, logs."""

    rules: tuple[str, ...]
    reason: str
    logs: tuple[str, ...]


class FailedJobs(logging.Handler):
    """Gathers the failed jobs that Snakemake's logger reports, also where its own lines are kept quiet."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.jobs: list[FailedJob] = []
        self._members: set[int] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record of a failed job or group; a group's members come again one by one and are passed over."""
        about = record.__dict__
        event = getattr(about.get("event"), "name", "")
        if event == "GROUP_ERROR":
            members = about["job_error_info"]
            self._members.update(member["jobid"] for member in members)
            logs = [*about["aux_logs"], *(path for member in members for path in member["log"])]
            rules = dict.fromkeys(member["rule_name"] for member in members)
            self.jobs.append(FailedJob(tuple(rules), "", tuple(map(str, logs))))
        elif event == "JOB_ERROR" and about["jobid"] not in self._members:
            reason = about["rule_msg"] or ""
            self.jobs.append(FailedJob((about["rule_name"],), reason, tuple(map(str, about["log"]))))


def failures(logs: Path, since: float, jobs: Iterable[FailedJob] = ()) -> list[str]:
    """Return what went wrong since a time [s since the epoch], one text each with the path of its log.

    First what stages say in their logs below ``logs``; then jobs whose logs hold no such word: killed from outside, out
    of memory or time, or ended with their node.
    """
    said: dict[str, str] = {}
    for path in sorted(logs.rglob("*.log")):
        if path.stat().st_mtime >= since:
            text = path.read_text(encoding="utf-8", errors="replace")
            if FAILED in text:
                said[str(path)] = text[text.rindex(FAILED) :].strip()
    out = [f"{text}\n  log:      {path}" for path, text in said.items()]
    for job in jobs:
        # "logs/x.log (check log file(s) for error details)"
        paths = [path.split(" (")[0] for path in job.logs]
        if not any(path in said for path in paths):
            found = f"\n  found:    {job.reason}" if job.reason else ""
            out.append(
                f"{', '.join(job.rules)}: ended without a word of its own (killed, out of memory or time?){found}"
                + "".join(f"\n  log:      {path}" for path in paths)
            )
    return list(dict.fromkeys(out))
