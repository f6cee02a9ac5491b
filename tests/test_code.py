"""What defines a class is told by its file: an edit alters it, a comment does not."""

import importlib
import sys
import zipfile
from contextlib import nullcontext
from pathlib import Path

import pytest

import lampopt
from lampopt.code import definition_of, source_of
from lampopt.errors import BankError
from lampopt.plugins import Plugins

sys.path.insert(0, str(Path(__file__).parent))
import small

PLAIN = "LIMIT = 3\n\n\nclass Judge:\n    def call(self):\n        return LIMIT\n"


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Writes a module and gives its class `Judge`."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(text, name="a_module"):
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
        sys.modules.pop(name, None)
        importlib.invalidate_caches()
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        return importlib.import_module(name)

    return write


def test_comments_and_empty_lines_do_not_count(written):
    plain = source_of(written(PLAIN).Judge)
    assert source_of(written("# why\n" + PLAIN.replace("\n\n\n", "  # so\n\n")).Judge) == plain
    assert source_of(written(PLAIN.replace("3", "4")).Judge) != plain
    paged = "\x0c\n" + PLAIN.replace("\n", "\n# page 2\n", 1)
    assert source_of(written(paged).Judge) != source_of(written(paged.replace("3", "4")).Judge)
    assert source_of(written(PLAIN.replace("LIMIT = 3", "LIMIT = '# 3'")).Judge) != source_of(
        written(PLAIN.replace("LIMIT = 3", "LIMIT = '# 4'")).Judge
    )


def test_it_is_that_of_the_file_as_it_was_first_read(written, tmp_path):
    """A process goes on with what it has imported."""
    judge = written(PLAIN).Judge
    before = source_of(judge)
    (tmp_path / "a_module.py").write_text(PLAIN.replace("3", "4"), encoding="utf-8")
    assert source_of(judge) == before


def test_what_has_no_file_is_like_nothing_else():
    one, other = (type("Judge", (), {"__module__": "nowhere"}) for _ in range(2))
    assert source_of(one) == ""
    assert definition_of(one) == definition_of(one) != definition_of(other)


def test_an_archive_is_read(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "packed.zip", "w") as archive:
        archive.writestr("a_packed.py", PLAIN)
    monkeypatch.syspath_prepend(tmp_path / "packed.zip")
    assert source_of(importlib.import_module("a_packed").Judge) != ""


DECODER = """
import small

class Longer(small.Stretch):
    def fit(self, shared, meshes, *, seed, progress=None):
        weights, error = super().fit(shared, meshes, seed=seed, progress=progress)
        weights[:, 0] *= FACTOR
        return weights, error
"""


@pytest.mark.parametrize("finished", [True, False])
def test_a_bank_is_not_built_by_two_versions_of_a_decoder(written, tmp_path, monkeypatch, finished):
    class Mine:
        @lampopt.hookimpl
        def lampopt_decoders(self):
            return {"longer": "a_decoder:Longer"}

    def build(factor):
        written(DECODER.replace("FACTOR", factor), "a_decoder")
        plugins = Plugins.load([("small", small.Plugin()), ("mine", Mine())])
        return small.bank(decoder="longer", store=tmp_path / "a.lamp", plugins=plugins)

    small.CALLS.clear()
    monkeypatch.setattr(small, "INTERRUPT", [0 if finished else 3])
    with nullcontext() if finished else pytest.raises(KeyboardInterrupt):
        build("1.0")
    monkeypatch.setattr(small, "INTERRUPT", [0])
    holds = "holds a bank" if finished else "holds the beginning of a bank"
    with pytest.raises(BankError, match=f"{holds} made from other exemplars, options or seed"):
        build("1.5")
    assert build("1.0").weights[0, 0] == pytest.approx(small.bank().weights[0, 0])


def test_empty_lines_within_a_text_are_part_of_it():
    from lampopt.code import _uncommented

    assert _uncommented('t = """a\n\nb"""\n') != _uncommented('t = """a\nb"""\n')
    assert _uncommented("a = 1  # one\n\n\nb = 2\n") == _uncommented("# two\na = 1\nb = 2\n")
    assert _uncommented("if a:\n    b\nc\n") != _uncommented("if a:\n    b\n    c\n")
