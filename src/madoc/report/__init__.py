"""A run folder as a page to look at; it reads folders only, and knows no method by name.

The names are in `__init__.pyi`; each is imported when it is first used, as the records are wanted without the page.
"""

from madoc import lazily

__getattr__, __dir__, __all__ = lazily(__name__)
