"""Which OpenFOAM is there: Debian's, a later one of openfoam.com or openfoam.org, in a container or on another host."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lampopt.errors import InputError

from .outcomes import FlowError

DEBIAN = Path("/usr/share/openfoam")  # where Debian's package has what other makes name in a login script
MODULAR = 11  # openfoam.org's version from which on one program solves everything
PATIENCE_S = 60  # for the question which version it is
ASK = "install Debian's package (apt install openfoam), put another one on the PATH, or name a container by command="


@dataclass(frozen=True)
class Installed:
    """One OpenFOAM.

    Parameters
    ----------
    make, version
        "openfoam.com" and "1912", "openfoam.org" and "10".
    command
        Words before each tool: of a container or a remote host. `{case}` in them stands for the case's folder.
    environment
        What tools need besides that of this process.
    """

    make: str
    version: str
    command: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.make} {self.version}"

    @property
    def modular(self) -> bool:
        """Whether solvers are modules of one program, and tools are called otherwise, as with openfoam.org from 11."""
        return self.make == "openfoam.org" and int(self.version.partition(".")[0].strip("v") or 0) >= MODULAR

    def words(self, tool: str, *arguments: str, case: Path) -> list[str]:
        """What to call for `tool` in `case`."""
        names = {"simpleFoam": "foamRun", "postProcess": "foamPostProcess"} if self.modular else {}
        return [*(word.replace("{case}", str(case)) for word in self.command), names.get(tool, tool), *arguments]


def words(command: object) -> tuple[str, ...]:
    """The words of `command`, as a shell tells them apart. Raises InputError where there are none to be told."""
    try:
        if isinstance(command, str):
            return tuple(shlex.split(command))
        why = ""
    except ValueError as error:
        why = f": {error}"
    raise InputError(f"command: expected words as for a shell, got {command!r:.80}{why}")


def installed(command: str, case: Path) -> Installed:
    """The OpenFOAM that `command` leads to, by default the one on the PATH.

    Raises
    ------
    FlowError
        "absent", where there is none, or it does not say its version.
    """
    before = words(command)
    environment = {} if before else _environment()
    said = ""
    for tool in ("simpleFoam", "foamRun"):
        call = [*(word.replace("{case}", str(case)) for word in before), tool, "-help"]
        if not shutil.which(call[0]):
            said = said or f"no {call[0]} on the PATH"
            continue
        try:
            done = subprocess.run(
                call, capture_output=True, text=True, timeout=PATIENCE_S, env=os.environ | environment, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            said = f"{shlex.join(call)}: {error}"
            continue
        if found := _told(done.stdout + done.stderr):
            return Installed(*found, before, environment)
        last = (done.stdout + done.stderr).strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        said = f"{shlex.join(call)} does not say its version: {last[0]}"
    raise FlowError(f"expected OpenFOAM, got none ({said}); {ASK}", "absent")


def _environment() -> dict[str, str]:
    """What Debian's tools need outside of a login shell."""
    own = not os.environ.get("WM_PROJECT_DIR") and (DEBIAN / "etc" / "controlDict").exists()
    return {"WM_PROJECT_DIR": str(DEBIAN)} if own else {}


def _told(text: str) -> tuple[str, str] | None:
    """Make and version from what a tool says of itself: `Using: OpenFOAM-v2312 (2312)`, `OpenFOAM-10`."""
    if not (using := re.search(r"Using:\s*OpenFOAM(.*)", text)):
        return None
    line = using.group(1)
    year = re.search(r"\b(\d{4})\b", line.replace("v", " ").replace("-", " "))
    if "openfoam.com" in text or year:
        return ("openfoam.com", year.group(1)) if year else None
    version = re.search(r"-(\d+(?:\.\d+)*|dev)", line)
    return ("openfoam.org", version.group(1).replace("dev", "99")) if version else None
