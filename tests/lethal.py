"""Plugins and tasks for workers in other processes, which import them from here."""

import os
import signal
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lampopt
import lampopt.task


@dataclass(frozen=True)
class Dies:
    """Measure that kills its process on the design whose length stands in the file that LETHAL names, if any."""

    names = ("length",)
    units = ("L",)

    def __call__(self, mesh):
        fatal = Path(os.environ.get("LETHAL", "nowhere"))
        if fatal.exists() and abs(mesh.extents[0] - float(fatal.read_text())) < 1e-3:
            os.kill(os.getpid(), signal.SIGKILL)
        return mesh.extents[:1]


@dataclass(frozen=True)
class Garbage(Dies):
    """Measure that returns what is no value."""

    def __call__(self, mesh):
        return np.zeros(5)


@dataclass(frozen=True)
class Dear:
    """Measure that leaves a file for each volume in the folder where it is to keep its work."""

    folder: str = ""
    names = ("drag",)
    units = ("",)

    def kept_in(self, folder):
        return self if self.folder else replace(self, folder=str(folder))

    def __call__(self, mesh):
        place = Path(self.folder)
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{mesh.volume:.9g}").touch()
        return np.array([mesh.volume])


class Plugin:
    """Offers them."""

    @lampopt.hookimpl
    def lampopt_measures(self):
        return {"dies": Dies, "garbage": Garbage}


def differ():
    """Be of another version from now on."""
    lampopt.task.version = lambda name: "9"


def interrupted(when):
    """What is done in a worker that Ctrl-C reaches before, in or after a design, or never."""
    from lampopt.pool import interruptible

    done = []

    def press(now):
        if when == now:
            signal.raise_signal(signal.SIGINT)
        done.append(now)

    press("before")
    with suppress(KeyboardInterrupt), interruptible():
        press("in")
        done.append("designed")
    press("after")
    return done
