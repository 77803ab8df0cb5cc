"""The stages of the main job with their files, and `run_all`, which does them one after another.

The names are in `__init__.pyi`; each is imported when it is first used, so the command line reads its options quickly.
"""

from madoc import lazily

__getattr__, __dir__, __all__ = lazily(__name__)
