"""`<store>.partial/`: the finished parts of a build that has not come to its end, held by one process at a time."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from lampopt import lamp
from lampopt.errors import BankError
from lampopt.types import Array

log = logging.getLogger("lampopt")


@dataclass(frozen=True)
class Partial:
    """The folder of a build with this `plan`, a hash of all its inputs."""

    folder: Path
    plan: str

    @classmethod
    def beside(cls, store: Path, plan: str) -> Partial:
        """Where the parts of `store` are, if there are any."""
        return cls(store.with_name(store.name + ".partial"), plan)

    @classmethod
    @contextmanager
    def open(cls, store: Path, plan: str) -> Iterator[Partial]:
        """Begin or resume a build of `store`, under a lock.

        Raises
        ------
        BankError
            If the folder is of another plan, another process holds it, or it cannot be written.
        """
        from filelock import FileLock, Timeout

        partial = cls.beside(store, plan)
        partial._refuse_others()
        lock = FileLock(partial.folder / "build.lock")
        try:
            partial.folder.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=0)
        except Timeout as error:
            raise BankError(
                f"{partial.folder}: another process builds this bank; wait for it or name another store"
            ) from error
        except OSError as error:
            raise BankError(f"{partial.folder}: cannot be written: {error}") from error
        try:
            if not store.exists():
                partial._begin(store)
            yield partial
        finally:
            lock.release()

    def _refuse_others(self) -> None:
        if self._planned() not in (None, self.plan):
            raise BankError(
                f"{self.folder}: holds the beginning of a bank made from other exemplars, options or seed, or by "
                "another version of a plugin: delete it or name another store"
            )

    def _begin(self, store: Path) -> None:
        self._refuse_others()  # it may have come while the lock was not yet ours
        try:
            killed = (store.parent.glob(f"{escape(store.name)}.*.writing"), self.folder.glob("*.writing"))
            for left in (file for files in killed for file in files):
                left.unlink(missing_ok=True)
            if self._planned() == self.plan:
                log.info("resuming the build in %s", self.folder)
                return
            self.clear()  # of an unknown plan
            aside = self._note.with_name(f"{self._note.name}.writing")
            aside.write_text(json.dumps({"plan": self.plan}))
            os.replace(aside, self._note)
        except OSError as error:
            raise BankError(f"{self.folder}: cannot be written: {error}") from error

    @property
    def _note(self) -> Path:
        return self.folder / "plan.json"

    def _planned(self) -> str | None:
        try:
            return str(json.loads(self._note.read_text())["plan"])
        except (OSError, ValueError, KeyError, TypeError):  # not there, or killed while it was written
            return None

    def read(self, name: str) -> dict[str, Array] | None:
        """The arrays written under `name`; None if there are none, or not as they were written."""
        path = self.folder / f"{name}.safetensors"
        if not path.exists():
            return None
        try:
            return lamp.read(path)[0]
        except BankError as error:
            log.warning("%s; it is fitted again", error)
            return None

    def write(self, name: str, arrays: Mapping[str, Array]) -> None:
        """Keep `arrays` under `name`."""
        lamp.write(self.folder / f"{name}.safetensors", arrays, {"format": "lampopt part"})

    def clear(self) -> None:
        """Remove all parts, also those that were being written."""
        for part in self.folder.glob("*.safetensors*"):
            part.unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove the folder unless it is of another plan; parts go first, so that a kill leaves it recognisable."""
        if self._planned() in (None, self.plan):
            self.clear()
            shutil.rmtree(self.folder, ignore_errors=True)
