"""The stages of the main job with their files, and `run_all`, which does them one after another.

The names are in `__init__.pyi`; each is imported when it is first used, so the command line reads its options quickly.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
