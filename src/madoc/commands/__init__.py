"""The commands of `madoc`, one file each: a dataclass of options whose `run` does the work and returns an answer.

Nothing heavy is imported before `run`: `madoc --help` is quick.
"""
