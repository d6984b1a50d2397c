"""Store, dump or compare what the cases give.

::

    python tests/golden/update.py                  # rewrite the stored values, on purpose
    python tests/golden/update.py --dump FILE      # every array in full (.npz)
    python tests/golden/update.py --compare FILE   # bit by bit with such a dump; says what differs

``--only TEXT`` takes the cases whose names contain it. A dump of one commit, compared with another
on the same machine, says whether a change of the code changed a single bit.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1]))
import same_kernels  # noqa: F401  # before NumPy

# isort: split
import numpy as np
from cases import CASES, Arrays, why_not
from stored import STORED, kept, write


def run(only: str) -> dict[str, Arrays]:
    """The arrays of every case that can be run here; case -> name -> array."""
    found = {}
    for name, case in CASES.items():
        reason = why_not(name)
        if only not in name or reason:
            print(f"skipped {name}: {reason}", file=sys.stderr) if reason else None
            continue
        start = time.process_time()
        found[name] = case()
        print(f"{time.process_time() - start:6.2f} s  {name}", file=sys.stderr)
    return found


def joined(found: dict[str, Arrays]) -> Arrays:
    """One mapping, ``case:name`` to array."""
    return {f"{case}:{name}": a for case, arrays in found.items() for name, a in arrays.items()}


def differences(before: Arrays, now: Arrays) -> list[str]:
    """A line for each array that differs in a bit, is missing or new."""
    lines = [f"missing  {name}" for name in before if name not in now]
    lines += [f"new      {name}" for name in now if name not in before]
    for name in before.keys() & now.keys():
        a, b = before[name], now[name]
        if a.shape != b.shape or a.dtype != b.dtype:
            lines.append(f"differs  {name}: {a.dtype}{a.shape} became {b.dtype}{b.shape}")
        elif a.tobytes() != b.tobytes():
            apart = np.abs(np.nan_to_num(a.astype(float)) - np.nan_to_num(b.astype(float)))
            first = int(np.argmax(apart.reshape(len(a), -1).any(axis=1))) if a.ndim else 0
            lines.append(f"differs  {name}: by up to {apart.max():.3g}, first in row {first}")
    return sorted(lines)


def main() -> int:
    """Run the cases and do what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dump", type=Path, metavar="FILE", help="write every array in full")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="with a dump, bit by bit")
    parser.add_argument("--only", default="", metavar="TEXT", help="cases whose names contain it")
    args = parser.parse_args()
    found = run(args.only)
    if args.dump is not None:
        np.savez_compressed(args.dump, **joined(found))
        return 0
    if args.compare is not None:
        with np.load(args.compare) as file:
            before = {name: file[name] for name in file.files if args.only in name.split(":")[0]}
        lines = differences(before, joined(found))
        print("\n".join(lines) if lines else f"{len(before)} arrays, every bit the same")
        return 1 if lines else 0
    write({name: kept(arrays) for name, arrays in found.items()})
    print(f"wrote {', '.join(str(path) for path in sorted(STORED.glob('*.npz')))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
