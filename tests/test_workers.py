"""Sweeps by many workers: the same designs, bit for bit, in the same order; a worker may be lost, nothing else is."""

import errno
import importlib
import json
import logging
import multiprocessing
import os
import signal
import sqlite3
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lampopt
from lampopt import Study, results
from lampopt.errors import BankError, InputError, PluginError, StudyError, SweepError
from lampopt.pool import processes as own_processes

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import lethal  # noqa: E402
import small  # noqa: E402
import toys  # noqa: E402
from small import files, rows, told  # noqa: E402

GRID = {"length": [2.1, 2.3, -9.0, 2.5], "width": [1.1, 1.2]}  # those of a negative length have no surface
MEASURED = {"length": "extents.length", "width": "extents.width"}


@pytest.fixture(scope="module")
def bank():
    return small.bank(small.boxes(measured=MEASURED))


@pytest.fixture(scope="module")
def processes():
    with pool(2) as executor:
        yield executor


@pytest.fixture(autouse=True)
def fresh():
    small.CALLS.clear()


def pool(count):
    return ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))


def sweep(study, folder=None, executor=None, grid=GRID, extra=(), ahead=None):
    chosen = small.plugins(*extra)
    return lampopt.sweep(study, grid, folder, executor=executor, ahead=ahead, report=False, plugins=chosen)


@pytest.mark.parametrize("level", ["alpha", "mesh"])
@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_workers_make_the_same_designs_in_the_same_order(bank, tmp_path, processes, kind, level):
    study = Study(bank, measures=("size",), level=level)
    alone = list(sweep(study, tmp_path / "alone"))
    with ThreadPoolExecutor(3) as threads:
        together = list(sweep(study, tmp_path / "together", threads if kind == "threads" else processes))
    assert [told(r) for r in together] == [told(r) for r in alone]
    assert rows(tmp_path / "together") == rows(tmp_path / "alone")
    assert files(tmp_path / "together") == files(tmp_path / "alone")
    small.CALLS.clear()
    assert [r.checks for r in sweep(study, tmp_path / "together", processes)] == [r.checks for r in together]
    assert not small.CALLS["decode"]  # all are read back


def test_without_a_folder_too(bank, tmp_path, processes):
    with pytest.raises(StudyError, match="read the bank from its file, and this one is in none: name a folder"):
        next(sweep(Study(bank), None, processes))
    stored = lampopt.store_bank(bank, tmp_path / "a.lamp")
    alone = [told(r) for r in sweep(Study(stored))]
    assert [told(r) for r in sweep(Study(stored), None, processes)] == alone
    with ThreadPoolExecutor(2) as threads:
        assert [told(r) for r in sweep(Study(bank), None, threads)] == alone
    with pytest.raises(StudyError, match="is in none"):  # altered in memory: the file holds another
        next(sweep(Study(replace(stored, limits={"alpha": 0.5})), None, processes))


def test_half_of_it_made_alone_the_rest_together(bank, tmp_path, processes):
    list(sweep(Study(bank), tmp_path / "whole"))
    begun = sweep(Study(bank), tmp_path / "run")
    for _ in range(3):
        next(begun)
    begun.close()
    small.CALLS.clear()
    assert len(list(sweep(Study(bank), tmp_path / "run", processes))) == 8
    assert not small.CALLS["decode"]
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")


def test_one_target_asked_for_twice_is_made_once(bank, tmp_path):
    tables = [{"length": 2.5}, {"length": 2.5}, {"length": 2.6}, {"length": 2.5}]
    with ThreadPoolExecutor(2) as threads:
        found = list(sweep(Study(bank), tmp_path, threads, tables))
    assert [r.design.target["length"] for r in found] == [2.5, 2.5, 2.6, 2.5]
    assert small.CALLS["decode"] == len(rows(tmp_path)) == 2


class Counting(ThreadPoolExecutor):
    """Threads that count how many designs are under way or not yet taken."""

    def __init__(self):
        super().__init__(2)
        self.submitted = 0

    def submit(self, *task, **named):
        self.submitted += 1
        return super().submit(*task, **named)


def test_only_a_few_are_under_way(bank, tmp_path):
    grid = {"length": np.linspace(2.1, 2.9, 200).tolist()}
    most = 2 * max(os.cpu_count(), 2)
    with Counting() as threads:
        begun = sweep(Study(bank, level="alpha"), tmp_path, threads, grid)
        for taken in range(1, 10):
            next(begun)
            assert threads.submitted <= most + taken
        begun.close()
        assert threads.submit(int).result() == 0  # it is the caller's, and goes on


@pytest.mark.parametrize("ahead", [1, 3])
def test_how_many_are_under_way_can_be_said(bank, tmp_path, ahead):
    grid = {"length": np.linspace(2.1, 2.9, 9).tolist()}
    with Counting() as threads:
        begun = sweep(Study(bank, level="alpha"), tmp_path, threads, grid, ahead=ahead)
        for taken in range(9):
            next(begun)
            assert threads.submitted == min(ahead + taken, 9)
        for wrong in (0, 2.0, True):
            with pytest.raises(StudyError, match="ahead: expected a whole number from 1 and an executor, got"):
                sweep(Study(bank), tmp_path, threads, ahead=wrong)
    with pytest.raises(StudyError, match="ahead: expected a whole number from 1 and an executor, got 2 and None"):
        sweep(Study(bank), tmp_path, ahead=2)


class Eager:
    """An executor that is none of the standard library's, and answers in the order of the last first."""

    def submit(self, function, /, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future


def test_any_executor(bank, tmp_path):
    alone = [told(r) for r in sweep(Study(bank))]
    assert [told(r) for r in sweep(Study(bank), tmp_path, Eager())] == alone
    with pytest.raises(StudyError, match=r"executor: expected one as in concurrent\.futures, with submit, got 4"):
        sweep(Study(bank), tmp_path, 4)
    with ThreadPoolExecutor(1) as over:
        pass
    with pytest.raises(StudyError, match="executor: expected one that takes work, got one that does not: cannot sched"):
        next(sweep(Study(bank), tmp_path / "other", over))


def test_one_that_takes_no_more_work(bank, tmp_path):
    with ThreadPoolExecutor(1) as threads:
        begun = sweep(Study(bank), tmp_path, threads, ahead=2)
        next(begun)
        threads.shutdown(wait=True)
        with pytest.raises(
            SweepError, match=r"lost: .*it takes no more work: cannot schedule.*: 2 of 8 designs are done"
        ):
            next(begun)
            next(begun)


class Strange:
    """An executor of threads that is none of the standard library's."""

    def __init__(self, count=1):
        self.inner = ThreadPoolExecutor(count)

    def submit(self, function, /, *arguments):
        return self.inner.submit(function, *arguments)


def test_what_ctrl_c_does_in_somebodys_own_process_is_left_alone(bank, tmp_path):
    """A job in the background of a shell ignores it: that does not make its threads workers of ours."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        alone = [told(r) for r in sweep(Study(bank), tmp_path / "alone")]
        for executor in (Strange(), Eager()):
            assert [told(r) for r in sweep(Study(bank), tmp_path / type(executor).__name__, executor)] == alone
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_threads_of_one_worker_open_the_bank_once(bank, tmp_path, monkeypatch):
    alone = [told(r) for r in sweep(Study(bank), tmp_path / "alone")]
    opened, of = [], lampopt.workers.Task.of

    def slow(*given):
        opened.append(of(*given))
        time.sleep(0.2)
        return opened[-1]

    lampopt.workers._unpacked.cache_clear()
    monkeypatch.setattr("lampopt.workers.Task.of", slow)
    assert [told(r) for r in sweep(Study(bank), tmp_path / "run", Strange(4))] == alone
    assert len(opened) == 2  # here, and there


@pytest.mark.parametrize(
    ("when", "done", "then"),
    [
        ("never", ["before", "in", "designed", "after"], ["before", "in", "designed", "after"]),
        ("before", ["before", "after"], ["before", "after"]),
        ("in", ["before", "after"], ["before", "after"]),
        ("after", ["before", "in", "designed", "after"], ["before", "after"]),
    ],
)
def test_our_own_processes_are_interrupted_in_a_design_alone_and_begin_no_other(when, done, then):
    with own_processes(1) as executor:
        assert executor.submit(lethal.interrupted, when).result() == done
        assert executor.submit(lethal.interrupted, "never").result() == then


def test_what_a_worker_raises_is_raised_here(bank, tmp_path, processes):
    study = Study(bank, measures=("garbage",))
    with pytest.raises(PluginError, match=r"measure .garbage.: expected values of shape"):
        list(sweep(study, tmp_path, processes, extra=[("extra", lethal.Plugin())]))
    assert processes.submit(int).result() == 0


def test_a_lost_worker_costs_what_was_under_way_and_nothing_else(bank, tmp_path):
    study = Study(bank, measures=("dies",))
    list(sweep(study, tmp_path / "whole", extra=[("extra", lethal.Plugin())]))
    os.environ["LETHAL"] = str(tmp_path / "fatal")
    (tmp_path / "fatal").write_text("2.5")  # the length whose design kills its worker
    try:
        with (
            pool(2) as executor,
            pytest.raises(SweepError, match=r"a worker was lost.*: (\d) of 8 designs are done") as e,
        ):
            list(sweep(study, tmp_path / "run", executor, extra=[("extra", lethal.Plugin())]))
        done = len(rows(tmp_path / "run"))
        assert f"{done} of 8" in str(e.value)
        assert done < 8
        assert not list(tmp_path.rglob("*.writing"))
        (tmp_path / "fatal").unlink()
        small.CALLS.clear()
        assert len(list(sweep(study, tmp_path / "run", extra=[("extra", lethal.Plugin())]))) == 8
        assert small.CALLS["decode"] == 8 - done
        assert rows(tmp_path / "run") == rows(tmp_path / "whole")
        assert files(tmp_path / "run") == files(tmp_path / "whole")
    finally:
        del os.environ["LETHAL"]


class Later(ThreadPoolExecutor):
    """One thread that makes the last design first, and the first never: it is the one that fails."""

    def __init__(self):
        super().__init__(1)
        self.held = []

    def submit(self, function, /, *arguments):
        future = Future()
        self.held.append((future, function, arguments))
        if len(self.held) == 3:
            for later, task, given in self.held[1:]:
                later.set_result(task(*given))
            self.held[0][0].set_exception(PluginError("the first does not do"))
        return future


def test_what_others_have_finished_beside_one_that_failed_is_kept(bank, tmp_path):
    grid = {"length": [2.1, 2.2, 2.3], "width": [1.1]}
    with pytest.raises(PluginError, match="the first does not do"):
        list(sweep(Study(bank), tmp_path, Later(), grid))
    assert sorted(json.loads(row[1])["length"] for row in rows(tmp_path)) == [2.2, 2.3]
    small.CALLS.clear()
    assert len(list(sweep(Study(bank), tmp_path, grid=grid))) == 3
    assert small.CALLS["decode"] == 1


def test_what_is_finished_while_nobody_looks_is_kept(bank, tmp_path):
    grid = {"length": [2.1, 2.2, 2.3], "width": [1.1]}
    with ThreadPoolExecutor(3) as threads:
        begun = sweep(Study(bank), tmp_path, threads, grid)
        next(begun)
        threads.shutdown(wait=True)  # all three are finished now
        begun.close()
    assert len(rows(tmp_path)) == 3


def test_plugins_that_cannot_be_sent_are_named(bank, tmp_path, processes):
    class Local(lethal.Plugin):
        pass

    with pytest.raises(PluginError, match=r"plugins small, mine are not installed and cannot be sent .*ThreadPoolExec"):
        next(sweep(Study(bank), tmp_path, processes, extra=[("mine", Local())]))


def test_measures_of_the_main_program_are_refused(bank, tmp_path, processes, monkeypatch):
    monkeypatch.setattr(toys.Size, "__module__", "__main__")  # elsewhere __main__ is another program
    with pytest.raises(
        StudyError, match=r"measures or models mine cannot be sent .*main program.*define them in a module"
    ):
        next(sweep(Study(bank, measures={"mine": toys.Size()}), tmp_path, processes))


class Unknown(lethal.Plugin):
    """What the worker's modules lack."""

    def __reduce__(self):
        return importlib.import_module, ("nowhere",)


def test_what_a_worker_cannot_import_or_read_is_named(bank, tmp_path, monkeypatch):
    stored = lampopt.store_bank(bank, tmp_path / "a.lamp")
    with pytest.raises(
        PluginError, match=r"a worker, on .*, cannot import .*No module named 'nowhere'.*define it in a mod"
    ):
        list(sweep(Study(stored), tmp_path / "run", Strange(), extra=[("extra", Unknown())]))
    monkeypatch.setattr("lampopt.loop._bank_file", lambda task, folder: tmp_path / "b.lamp")
    with pytest.raises(BankError, match=r"a worker, on .*, cannot read the bank: .*b\.lamp: no such file.*same path"):
        list(sweep(Study(stored), tmp_path / "run", Strange()))


def test_a_worker_that_would_make_other_designs_is_refused(bank, tmp_path):
    with pool(1) as executor:
        executor.submit(lethal.differ).result()
        with pytest.raises(PluginError, match="a worker would make other designs"):
            next(sweep(Study(bank), tmp_path, executor))


def test_whatever_stops_a_sweep_how_much_is_done_is_said(bank, tmp_path, caplog):
    grid = {"length": [2.1, 2.2, 2.3], "width": [1.1]}
    list(sweep(Study(bank), tmp_path, grid={"length": [2.1], "width": [1.1]}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lampopt.record._put", full)
        with pytest.raises(InputError, match="No space left on device"):
            list(sweep(Study(bank), tmp_path, grid=grid))
    assert f"stopped: 1 of 3 designs are done and kept in {tmp_path}; the same sweep goes on" in caplog.text


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_interrupted_says_what_is_left(bank, tmp_path, caplog):
    class Interrupts:
        @lampopt.hookimpl
        def lampopt_recorded(self, result, folder):
            if result.design.target["length"] == 2.3:
                raise KeyboardInterrupt

    with caplog.at_level(logging.WARNING, "lampopt"):
        with pytest.raises(KeyboardInterrupt):
            list(sweep(Study(bank), tmp_path, extra=[("stop", Interrupts())]))
        assert f"interrupted: 3 of 8 designs are done and kept in {tmp_path}; the same sweep goes on" in caplog.text
    assert len(rows(tmp_path)) == 3
    assert len(list(sweep(Study(bank), tmp_path))) == 8


def test_results_come_in_the_sweeps_order_whoever_was_done_first(tmp_path):
    """The first design waits until another one is in the database; read back they come as asked."""

    def recorded():
        with closing(sqlite3.connect(tmp_path / "runs.sqlite")) as database:
            return [json.loads(t)["length"] for (t,) in database.execute("SELECT target FROM designs ORDER BY rowid")]

    class Late(ThreadPoolExecutor):
        def submit(self, call, task, target, mix):
            def work():
                until = time.monotonic() + 60
                while target["length"] == 2.1 and not recorded() and time.monotonic() < until:
                    time.sleep(0.01)
                return call(task, target, mix)

            return super().submit(work)

    study = Study(small.bank(), level="alpha")
    grid = {"length": [2.1, 2.2, 2.3]}
    with Late(2) as executor:
        swept = list(lampopt.sweep(study, grid, tmp_path, executor=executor, report=False, plugins=small.plugins()))
    assert recorded()[0] != 2.1
    read = [result.design.target["length"] for result in results(tmp_path, plugins=small.plugins())]
    assert read == [result.design.target["length"] for result in swept] == grid["length"]
    grown = {"length": [2.4, 2.3, 2.05, 2.1]}  # the same study: its designs in the new order, then the one left over
    list(lampopt.sweep(study, grown, tmp_path, report=False, plugins=small.plugins()))
    read = [result.design.target["length"] for result in results(tmp_path, plugins=small.plugins())]
    assert read == [*grown["length"], 2.2]
