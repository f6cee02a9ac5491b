"""lampopt: parameter-controlled shapes from a few dozen exemplars."""

from lampopt.hookspecs import hookimpl

__all__ = ["hookimpl"]
