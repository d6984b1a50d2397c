"""What an entry point is, and how one input is tried on it."""

from __future__ import annotations

import faulthandler
import shutil
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mutations import Rng

from ms_slam_env.errors import InputError

LIMIT_S = 60.0
"""Of one input; one that takes longer hangs, and the process ends with a traceback of where."""


@dataclass(frozen=True)
class Entry:
    """One place where something from outside comes in.

    Attributes:
        name: for the command line and the records.
        seed: makes a valid input; what takes time is remembered by the entry's module.
        mutate: an input and random numbers to another input.
        call: gives an input to the package, with an empty folder to work in. It returns where the
            input was taken and its result is as it should be, and raises ``InputError`` where
            it was refused. All else is a fault.
        in_tests: how many inputs the project's tests try.
    """

    name: str
    seed: Callable[[], Any]
    mutate: Callable[[Any, Rng], Any]
    call: Callable[[Any, Path], None]
    in_tests: int = 30


@dataclass(frozen=True)
class Outcome:
    """Of one input: ``taken``, ``refused`` or ``fault``, with the traceback of a fault."""

    number: int
    verdict: str
    fault: str = ""


def attempt(entry: Entry, number: int, limit_s: float = LIMIT_S) -> Outcome:
    """Try input ``number`` of an entry point; 0 is the valid one. The same number, the same input.

    To refuse without a word is a fault, too.
    """
    folder = Path(tempfile.mkdtemp(prefix="fuzz"))
    faulthandler.dump_traceback_later(limit_s, exit=True, file=sys.__stderr__)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = entry.seed()
            if number:
                value = entry.mutate(value, np.random.default_rng([number, len(entry.name)]))
            entry.call(value, folder)
    except InputError as error:
        text = str(error)
        if number == 0 or not text.strip():
            return Outcome(number, "fault", f"InputError: {text!r}")
        return Outcome(number, "refused")
    except Exception:
        return Outcome(number, "fault", traceback.format_exc())
    finally:
        faulthandler.cancel_dump_traceback_later()
        shutil.rmtree(folder, ignore_errors=True)
    return Outcome(number, "taken")
