"""Command lines one after another in this process: what each answered, its processor time in s, and its memory.

Standard input has a JSON list of lists of words, standard output gets a JSON list of answers.
"""

import contextlib
import io
import json
import sys
import time
import traceback

from madoc.commands.main import main
from madoc.runs.machine import forget_peak, peak_memory


def answered(words):
    """Exit code, standard output and error, seconds of processor time, and the most memory in bytes while it ran."""
    out, err = io.StringIO(), io.StringIO()
    forget_peak()
    begun = time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except BaseException:
            code = -1
            traceback.print_exc()
    seconds = time.process_time() - begun
    return {"code": code, "out": out.getvalue(), "err": err.getvalue(), "seconds": seconds, "memory": peak_memory()}


def main_of_all():
    """Answer all; the first once before, as importing takes seconds."""
    lines = json.load(sys.stdin)
    answered(lines[0])
    told = [answered(words) for words in lines]
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main_of_all()
