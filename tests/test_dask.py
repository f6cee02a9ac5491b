"""Sweeps through Dask: the designs of one process, bit for bit; workers are killed, and nothing is recorded twice."""

import json
import os
import signal
import sqlite3
import sys
import threading
from collections import Counter
from concurrent.futures import Future
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Study
from lampopt.crew import Crew, given_up, lost
from lampopt.errors import PluginError, SweepError

distributed = pytest.importorskip("distributed", reason="the extra dask is not installed: pip install 'lampopt[dask]'")
dask = pytest.importorskip("dask")

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import lethal  # noqa: E402
import small  # noqa: E402
from small import files, rows, told  # noqa: E402

GRID = {"length": [2.1, 2.3, -9.0, 2.5], "width": [1.1, 1.2]}  # those of a negative length have no surface
MANY = {"length": [2.1 + i / 100 for i in range(20)], "width": [1.1]}


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes(measured={"length": "extents.length", "width": "extents.width"}))


@contextmanager
def cluster(folder, workers=2, threads=1, config=None, **options):
    """A client of a cluster of this machine: processes behind TCP, or threads of this process."""
    with (
        dask.config.set({"temporary-directory": str(folder), **(config or {})}),
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=threads, dashboard_address="127.0.0.1:0", **options
        ) as made,
        distributed.Client(made) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    """Two workers whose designs take a while; one kills its worker if its length stands in the file `fatal`."""
    folder = tmp_path_factory.mktemp("dask")
    env = {"SMALL_SLOW": "0.05", "LETHAL": str(folder / "fatal")}
    with cluster(folder, processes=True, env=env) as client:
        client.fatal = folder / "fatal"
        yield client


@pytest.fixture
def here(tmp_path):
    """Two workers that are threads of this process."""
    with cluster(tmp_path / "dask", processes=False) as client:
        yield client


def sweep(study, folder, client=None, grid=GRID, extra=()):
    executor = None if client is None else client.get_executor()
    return lampopt.sweep(study, grid, folder, executor=executor, report=False, plugins=small.plugins(*extra))


class Recorded:
    """Observer that counts how often each design is recorded."""

    def __init__(self):
        self.times = Counter()

    @lampopt.hookimpl
    def lampopt_recorded(self, result, folder):
        self.times[json.dumps(dict(result.design.target))] += 1


def test_a_cluster_makes_the_same_designs_in_the_same_order(bank, tmp_path, processes):
    study = Study(bank, measures=("size",))
    alone = list(sweep(study, tmp_path / "alone"))
    together = list(sweep(study, tmp_path / "together", processes))
    assert [told(r) for r in together] == [told(r) for r in alone]
    assert rows(tmp_path / "together") == rows(tmp_path / "alone")
    assert files(tmp_path / "together") == files(tmp_path / "alone")
    for one, other in zip(together, alone, strict=True):
        if other.design.mesh is not None:
            assert one.design.mesh.vertices.flags.writeable == other.design.mesh.vertices.flags.writeable
    assert not processes.futures  # no worker keeps what is recorded here


def test_one_worker_killed_in_the_middle(bank, tmp_path, processes):
    whole = [told(r) for r in sweep(Study(bank), tmp_path / "whole", grid=MANY)]
    recorded = Recorded()
    found = []
    for result in sweep(Study(bank), tmp_path / "run", processes, MANY, [("observer", recorded)]):
        found.append(told(result))
        if len(found) == 5:
            before = processes.run(os.getpid)
            os.kill(next(iter(before.values())), signal.SIGKILL)
    assert found == whole
    assert set(recorded.times.values()) == {1}
    assert len(recorded.times) == len(MANY["length"])
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert files(tmp_path / "run") == files(tmp_path / "whole")
    with closing(sqlite3.connect(tmp_path / "run" / "runs.sqlite")) as database:  # a row written anew has a new number
        assert database.execute("SELECT max(rowid) FROM designs").fetchone()[0] == len(found)
    assert set(processes.run(os.getpid).values()) != set(before.values())


def test_a_design_that_kills_its_workers_is_named(bank, tmp_path, processes):
    study, plugins = Study(bank, measures=("dies",)), [("extra", lethal.Plugin())]
    processes.fatal.write_text("2.5")
    processes.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 0))
    with pytest.raises(SweepError, match=r"lost: .*\(design {'length': .*workers died.*: \d of 8 designs are done"):
        list(sweep(study, tmp_path / "run", processes, extra=plugins))
    processes.fatal.unlink()
    recorded, done = Recorded(), len(rows(tmp_path / "run"))
    assert len(list(sweep(study, tmp_path / "run", extra=[*plugins, ("observer", recorded)]))) == 8
    assert sum(recorded.times.values()) == 8 - done


def test_all_workers_gone_and_the_cluster_closed(bank, tmp_path, here, monkeypatch, caplog):
    monkeypatch.setattr("lampopt.crew.PATIENCE", 0.5)
    monkeypatch.setattr("lampopt.crew.LOOK", 0.1)
    monkeypatch.setenv("SMALL_SLOW", "0.1")
    begun = sweep(Study(bank), tmp_path / "run", here, MANY)
    next(begun)
    here.cluster.scale(0)
    with pytest.raises(SweepError, match=r"lost: .*\): \d+ of 20") as caught:
        list(begun)
    reason = str(caught.value)
    if "lost before it was fetched" not in reason:  # a result may go with its worker just when it is asked for
        assert "all that the cluster had, and in 0.5 s no other has come" in reason
        assert "no worker of the cluster is there" in caplog.text
    here.cluster.scale(1)
    begun = sweep(Study(bank), tmp_path / "run", here, MANY)
    for _ in range(len(rows(tmp_path / "run")) + 1):
        next(begun)
    here.cluster.close()
    with pytest.raises(SweepError, match=r"a worker was lost: .* of 20 designs are done"):
        list(begun)
    monkeypatch.setenv("SMALL_SLOW", "0")
    assert len(list(sweep(Study(bank), tmp_path / "run", grid=MANY))) == 20


def test_the_first_worker_is_waited_for(bank, tmp_path, monkeypatch):
    monkeypatch.setattr("lampopt.crew.PATIENCE", 0.0)
    monkeypatch.setattr("lampopt.crew.LOOK", 0.1)
    with cluster(tmp_path / "dask", 0, processes=False) as client:
        late = threading.Timer(1.0, client.cluster.scale, [1])
        late.start()
        assert len(list(sweep(Study(bank), tmp_path / "run", client))) == 8
        late.join()


def test_dask_says_itself_how_long_workers_are_waited_for(tmp_path):
    with (
        cluster(
            tmp_path / "dask", 0, processes=False, config={"distributed.scheduler.no-workers-timeout": "500 ms"}
        ) as client,
        pytest.raises(SweepError, match=r"a worker was lost: .*timed out after 500.00 ms waiting.*: 0 of 8 designs"),
    ):
        list(sweep(Study(small.bank()), tmp_path / "run", client))


def test_as_many_are_under_way_as_suit_the_cluster(tmp_path):
    with cluster(tmp_path, 2, 50, processes=False) as client:
        assert Crew(client.get_executor()).ahead == 2 * max(100, os.cpu_count())


def test_what_dask_keeps_is_not_taken_for_a_new_design(bank, tmp_path, here):
    lampopt.store_bank(bank, tmp_path / "a.lamp")
    small.CALLS.clear()
    tables = [{"length": 2.5}] * 3
    assert len(list(sweep(Study(tmp_path / "a.lamp"), None, here, tables))) == 3
    assert small.CALLS["decode"] == 3  # in no folder, each is made


def test_what_a_worker_raises_is_raised_here_each_time_anew(bank, tmp_path, here):
    study, plugins = Study(bank, measures=("garbage",)), [("extra", lethal.Plugin())]
    held = []
    for _ in range(2):
        small.CALLS.clear()
        with pytest.raises(PluginError, match=r"measure 'garbage': expected values of shape") as error:
            list(sweep(study, tmp_path / "run", here, {"length": [2.5]}, plugins))
        held.append(error)  # as long as it is, Dask keeps what has failed
        assert small.CALLS["decode"]


class Vanished:
    """A future of Dask whose result was there and is lost before it is fetched."""

    key, status = "judge", "lost"

    def __init__(self, answer):
        self.answer = answer

    async def _result(self, raiseit):
        return self.answer


@pytest.mark.parametrize("answer", [object(), [1.0], np.ones(3)], ids=["object", "one", "three"])
def test_a_result_lost_on_its_way_is_no_error_of_the_design(here, answer):
    future = Future()
    here.sync(distributed.cfexecutor._cascade_future, Vanished(answer), future)
    found = future.exception(timeout=10)
    assert lost(found) and given_up(found) == "what it gave was lost before it was fetched"
    with pytest.raises(TypeError) as error:
        here.get_executor().submit(int, None).result()
    assert not lost(error.value)


def test_a_sweep_that_is_left_gives_its_designs_up(bank, tmp_path, here, monkeypatch):
    monkeypatch.setenv("SMALL_SLOW", "0.2")
    begun = sweep(Study(bank), tmp_path / "run", here, MANY)
    assert any(here.futures for _ in begun)  # slow machines have done all that was sent when one is there
    begun.close()
    assert not here.futures
    assert here.submit(int).result() == 0  # it is the caller's, and goes on
