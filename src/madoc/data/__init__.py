"""Logged data: `load` reads a file of any supported format into a `Dataset`, `save` writes Madoc's own.

The names are in `__init__.pyi`; each is imported when it is first used, as options are declared here too.
"""

from madoc import lazily

__getattr__, __dir__, __all__ = lazily(__name__)
