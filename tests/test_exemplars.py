"""The first stage: options as one has them in Python, and sources that are none."""

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

import lampopt
from lampopt.errors import InputError, PluginError

sys.path[:0] = [p for p in (str(Path(__file__).parent),) if p not in sys.path]
import small  # noqa: E402
import toys  # noqa: E402

GIVEN = []


@dataclass(frozen=True)
class Asked:
    """Source that keeps what it was asked."""

    table: str = ""
    labels: str = ""
    count: int = 3

    def __call__(self):
        GIVEN.append(self)
        return toys.Boxes(self.count)()


@dataclass(frozen=True)
class Nothing:
    def __call__(self):
        return []


class Plugin:
    @lampopt.hookimpl
    def lampopt_sources(self):
        return {"asked": Asked, "nothing": Nothing, "solid": object}


PLUGINS = small.plugins(("mine", Plugin()))


def asked(**options):
    exemplars = lampopt.exemplars("asked", plugins=PLUGINS, **options)
    assert isinstance(exemplars, lampopt.Exemplars)
    return GIVEN[-1]


class Place:
    def __fspath__(self):
        return "far/cars.csv"


@pytest.mark.parametrize("path", [Path("far/cars.csv"), "far/cars.csv", Place()], ids=["path", "text", "like"])
def test_a_path_is_as_good_as_its_text(path):
    assert asked(table=path, count=4) == Asked(str(Path("far/cars.csv")), "", 4)


@pytest.mark.parametrize(
    ("labels", "text"), [(["drag", "lift"], "drag,lift"), (("drag",), "drag"), ([], ""), ("drag, lift", "drag, lift")]
)
def test_names_may_be_a_list(labels, text):
    assert asked(labels=labels).labels == text


@pytest.mark.parametrize("labels", [["drag, wet"], ["drag", 3], [None]])
def test_a_list_that_cannot_be_text_with_commas_is_refused(labels):
    with pytest.raises(InputError, match="option 'labels': expected texts without commas, got"):
        asked(labels=labels)


@pytest.mark.parametrize("labels", [{"drag"}, None, 1j, b"drag"])
def test_what_else_is_no_option_is_refused(labels):
    with pytest.raises(InputError, match="option 'labels' of 'asked': expected text, a number or a truth value, got"):
        asked(labels=labels)


def test_a_list_where_a_number_is_wanted_is_refused():
    with pytest.raises(PluginError, match="option 'count': expected int, got '1,2'"):
        asked(count=["1", "2"])


def test_options_join_those_of_a_spec():
    lampopt.exemplars(lampopt.Spec("asked", count=2, labels="drag"), labels=["lift"], plugins=PLUGINS)
    assert GIVEN[-1] == Asked("", "lift", 2)


def test_sources_that_are_none():
    with pytest.raises(PluginError, match=r"source 'solid': <object .* lacks what lampopt\.protocols\.Source asks for"):
        lampopt.exemplars("solid", plugins=PLUGINS)
    with pytest.raises(PluginError, match="source 'nothing': expected Exemplars, got list"):
        lampopt.exemplars("nothing", plugins=PLUGINS)
