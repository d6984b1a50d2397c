"""Fuzz at length: ``python tests/fuzz/run.py --inputs 10000 --entry tum image --out results/fuzz``.

Each entry point runs in a process of its own, which may crash or hang. What was tried is recorded
input by input and not tried again; a fault is recorded with its number, which makes the input.
``--entry NAME --only NUMBER`` tries one input again. Exit code 1 if there is a fault.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1]))

from entries import ENTRIES
from fuzzing import LIMIT_S, attempt

from ms_slam_env.report.provenance import provenance
from ms_slam_env.report.records import RecordFile, Row, write_json

MEMORY_BYTES = 12 * 2**30
RECORDS = "inputs.jsonl"
SUMMARY = "fuzz.json"


def main() -> int:
    """Fuzz, write the summary, and print the faults."""
    args = arguments()
    if args.child:
        return child(args.entry[0], args.start, args.inputs, args.limit)
    if args.only is not None:
        outcome = attempt(ENTRIES[args.entry[0]], args.only, args.limit)
        print(outcome.verdict, outcome.fault)
        return int(outcome.verdict == "fault")
    names = args.entry or list(ENTRIES)
    counts = {name: fuzz(name, args.inputs, args.limit, args.out / name) for name in names}
    write_json(args.out / SUMMARY, {"provenance": provenance(), "inputs": counts})
    return int(any(count["fault"] for count in counts.values()))


def arguments() -> Any:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--inputs", type=int, default=1000, help="of each entry point")
    parser.add_argument("--entry", nargs="*", choices=list(ENTRIES), help="by default all")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="seconds for an input")
    parser.add_argument("--out", type=Path, default=Path("results/fuzz"))
    parser.add_argument("--only", type=int, help="number of the one input to try")
    parser.add_argument("--start", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def fuzz(name: str, inputs: int, limit_s: float, out: Path) -> dict[str, int]:
    """Try the inputs of one entry point that have not been tried; count the verdicts."""
    records = RecordFile(out / RECORDS)
    rows = records.load()
    begin = time.monotonic()
    while len(rows) <= inputs:
        for row in tried_by_child(name, len(rows), inputs, limit_s):
            records.append(row)
            rows[row["key"]] = row
    counts = Counter(row["verdict"] for row in rows.values())
    found = {verdict: counts[verdict] for verdict in ("taken", "refused", "fault")}
    print(f"{name}: {found}, {time.monotonic() - begin:.0f} s", flush=True)
    for row in rows.values():
        if row["verdict"] == "fault":
            print(f"  {row['key']}: {row['fault'].strip().splitlines()[-1][:300]}", flush=True)
    return found


def tried_by_child(name: str, start: int, inputs: int, limit_s: float) -> list[Row]:
    """Rows of a process that tries inputs from ``start`` on; the last is the one it died of."""
    command = [sys.executable, __file__, "--child", "--entry", name, "--limit", str(limit_s)]
    command += ["--start", str(start), "--inputs", str(inputs)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"key"')]
    if done.returncode and start + len(rows) <= inputs:
        why = f"{done.stderr[-3000:]}\nprocess ended with code {done.returncode}"
        rows.append({"key": str(start + len(rows)), "verdict": "fault", "fault": why})
    return rows


def child(name: str, start: int, inputs: int, limit_s: float) -> int:
    """Try inputs one by one and print a row for each, some hundred in a process."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    for number in range(start, min(inputs, start + 499) + 1):
        outcome = attempt(ENTRIES[name], number, limit_s)
        row = {"key": str(number), "verdict": outcome.verdict, "fault": outcome.fault}
        print(json.dumps(row), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
