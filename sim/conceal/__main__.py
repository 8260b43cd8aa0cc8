"""``python -m sim.conceal --seeds 0:150 --out DIR`` writes concealed cases and their answers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sim.conceal.cases import write

parser = argparse.ArgumentParser(description="Write concealed cases: DIR/case_SEED and DIR/answers/case_SEED.json.")
parser.add_argument("--seeds", default="0:10", help="first:last, last excluded (below 100000 for calibration)")
parser.add_argument("--out", type=Path, required=True, help="folder to write to")
arguments = parser.parse_args()
first, last = (int(part) for part in arguments.seeds.split(":"))
for seed in range(first, last):
    name = f"case_{seed:06d}"
    if (arguments.out / "answers" / f"{name}.json").exists():
        continue
    a = write(seed, arguments.out / name, arguments.out / "answers" / f"{name}.json")
    effects = " + ".join(e["name"] for e in a["effects"])
    sys.stdout.write(f"{name} {a['kind']} {a['sub'] or ''} {a['rig']} {a['strength'] or ''} {effects}\n")
    sys.stdout.flush()
