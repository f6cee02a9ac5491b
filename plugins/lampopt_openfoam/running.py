"""The tools, one after the other, each with its log; whatever becomes of them has a name.

foamlib writes and reads the case. The processes are our own: foamlib's cannot be ended when time is up or when
somebody interrupts, and show their progress on standard output.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from errno import EDQUOT, ENOSPC
from functools import lru_cache
from pathlib import Path
from threading import Event

from .installed import ASK, Installed
from .outcomes import FlowError, Outcome

Watch = Callable[[], bool]

TICK_S = 0.2  # between two looks at a running tool
GRACE_S = 5.0  # between asking a tool to end and ending it
FULL = 2_000_000  # free bytes below which a tool that failed is taken to have failed for want of room
MISSING = (126, 127)  # a shell's, a container's or ssh's word for a command that is not there
LOST = (125, 255)  # a container's and ssh's word for a failure of their own
UNREAD = re.compile(r"(cannot|could not|failed to) (find|open|read) (the )?file", re.IGNORECASE)
TAIL = 6  # lines of a log in a message


@dataclass(frozen=True)
class Runner:
    """Runs tools in one case until `deadline` [monotonic s], or until `stop` is set."""

    case: Path
    foam: Installed
    deadline: float
    kept: bool = True
    stop: Event = field(default_factory=Event)

    def run(self, tool: str, *arguments: str, fails: Outcome = "failed", watch: Watch | None = None) -> str:
        """Run `tool` to its end and give its log.

        Parameters
        ----------
        fails
            What it means when the flow or the grid does not come out: "diverged" of a floating-point exception,
            "bad-grid" of an error that the tool itself ends with. Whatever else a tool ends with is "failed".
        watch
            Looked at while it runs; True ends it at once.

        Raises
        ------
        FlowError
            By name: absent, killed, disk-full, timed-out, failed, or `fails`.
        """
        log = self.case / f"log.{tool}"
        words = [*_ending_with_us(), *self.foam.words(tool, *arguments, case=self.case)]
        try:
            with log.open("w", encoding="utf-8") as out:
                process = subprocess.Popen(
                    words,
                    cwd=self.case,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=subprocess.STDOUT,
                    env=os.environ | dict(self.foam.environment),
                    start_new_session=True,
                )
        except FileNotFoundError as error:
            raise FlowError(f"expected OpenFOAM's {tool}, got no {words[0]} on the PATH; {ASK}", "absent") from error
        except OSError as error:
            raise self._failed(tool, f"cannot be started: {error}", by(error)) from error
        try:
            self._mark(process.pid)
            seen_enough = self._wait(process, tool, watch)
        finally:
            _end(process)
            with suppress(OSError):
                (self.case / "running").unlink()
        text = log.read_text(encoding="utf-8", errors="replace")
        if not seen_enough and (process.returncode != 0 or "FOAM FATAL" in text):
            raise self._ended(tool, process.returncode, text, fails)
        return text

    def _wait(self, process: subprocess.Popen[bytes], tool: str, watch: Watch | None) -> bool:
        """Until it has ended; True where `watch` has seen enough before."""
        while process.poll() is None:
            if time.monotonic() > self.deadline:
                raise self._failed(tool, "was still running when the time was up; allow more by timeout_s", "timed-out")
            if self.stop.is_set():
                raise self._failed(tool, "was ended, since nobody waits for it any more; run it again", "killed")
            if watch is not None and watch():
                return True
            with suppress(subprocess.TimeoutExpired):
                process.wait(TICK_S)
        return False

    def _mark(self, pid: int) -> None:
        try:
            (self.case / "running").write_text(str(pid), encoding="ascii")
        except OSError as error:
            raise self._failed("the case", f"cannot be written: {error}", by(error)) from error

    def _ended(self, tool: str, code: int, text: str, fails: Outcome) -> FlowError:
        """What a tool's exit code and log come to."""
        number = -code if code < 0 else code - 128 if code > 128 else 0
        if "No space left on device" in text or self._full():
            return self._failed(tool, "ran out of disk space; make room, what is finished is kept", "disk-full")
        if code in MISSING:
            return FlowError(f"expected OpenFOAM's {tool}, got a command that is not there; {ASK}", "absent")
        if code in LOST:
            return self._failed(tool, f"was lost by what runs it, with exit code {code}; run it again", "failed")
        if number == signal.SIGFPE:
            outcome: Outcome = "diverged" if fails == "diverged" else "failed"
            return self._failed(tool, "ended in a floating-point exception", outcome)
        if number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGXCPU):
            return self._failed(
                tool, f"was ended from outside, by {signal.Signals(number).name}; run it again", "killed"
            )
        # It may abort with its own error; that a file is not there says nothing of the grid.
        by_itself = number in (0, signal.SIGABRT) and "FOAM FATAL ERROR" in text and not UNREAD.search(text)
        outcome = "bad-grid" if fails == "bad-grid" and by_itself else "failed"
        return self._failed(tool, f"ended with exit code {code}", outcome)

    def _failed(self, tool: str, what: str, outcome: Outcome) -> FlowError:
        log = self.case / f"log.{tool}"
        said = ""
        with suppress(OSError):
            lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines()]
            said = " | ".join(_telling(lines))
        where = f"its log is {log}" if self.kept else "name a folder= to keep its log"
        return FlowError(f"{tool} {what}; {where}{f': {said}' if said else ''}", outcome)

    def _full(self) -> bool:
        with suppress(OSError):
            return shutil.disk_usage(self.case).free < FULL
        return False


@lru_cache(maxsize=1)
def _ending_with_us() -> tuple[str, ...]:
    """Words before a tool that let the system end it should this process be killed; none where it does not know how."""
    words = ("setpriv", "--pdeathsig", "KILL")
    try:
        done = subprocess.run([*words, "true"], capture_output=True, check=False, timeout=GRACE_S)
    except (OSError, subprocess.TimeoutExpired):
        return ()
    return words if done.returncode == 0 else ()


def end_left_over(case: Path) -> None:
    """End what an earlier, killed run of ours left running in `case`."""
    with suppress(OSError, ValueError):
        pid = int((case / "running").read_text(encoding="ascii"))
        if Path(os.readlink(f"/proc/{pid}/cwd")) == case.resolve():
            os.killpg(pid, signal.SIGKILL)
    with suppress(OSError):
        (case / "running").unlink()


def _end(process: subprocess.Popen[bytes]) -> None:
    for end in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        with suppress(ProcessLookupError):
            os.killpg(process.pid, end)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE_S)


def by(error: OSError) -> Outcome:
    """What a file that cannot be written comes to."""
    return "disk-full" if error.errno in (ENOSPC, EDQUOT) else "failed"


def _telling(lines: list[str]) -> list[str]:
    """The lines of a log that say why: from the last error on, or the last ones."""
    lines = [line for line in lines if line]
    at = [i for i, line in enumerate(lines) if "FOAM FATAL" in line]
    return lines[at[-1] : at[-1] + TAIL] if at else lines[-2:]
