"""What the whole `marey knee segment` costs, stage by stage, beside what is asked: `python bench/knee_cost.py SHARED`.

    python bench/knee_cost.py SHARED [NAME ...]

Each NAME (dess, phantom_a, phantom_spl, phantom_spl_t1, pair; without one phantom_a) is segmented with its template by
the command itself, in a process of its own. Printed are the seconds of each stage and of its steps as run.json has
them, what is left (starting Python, writing files), the whole beside the limits, the work of the cores, and the most
memory. Where the code was changed, Numba compiles at first: run it twice.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BONE_S, KNEE_S, MEMORY_GB = 180.0, 600.0, 4.0
CASES = {
    "dess": (("dess",), "atlas"),
    "phantom_a": (("phantom_a",), "atlas"),
    "phantom_spl": (("phantom_spl",), "template_a"),
    "phantom_spl_t1": (("phantom_spl_t1",), "template_a"),
    "pair": (("phantom_spl", "phantom_spl_t1"), "template_a"),
}
OF_BONES = ("Reading", "Bones", "Surfaces")


def measure(shared: Path, name: str) -> None:
    volumes, template = CASES[name]
    knee = shared / "data" / "knee"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        typed = ["knee", "segment", *(str(knee / each / "image.nii.gz") for each in volumes)]
        typed += ["--template", str(knee / template), "--out", str(out), "--quiet"]
        began = time.perf_counter()
        command = subprocess.Popen([sys.executable, "-c", "from marey.cli.main import main; main()", *typed])
        _, status, used = os.wait4(command.pid, 0)
        whole = time.perf_counter() - began
        if os.waitstatus_to_exitcode(status):
            raise SystemExit(f"{name}: the command failed.")
        record = json.loads((out / "run.json").read_text(encoding="utf-8"))
        bones = len(list(out.glob("*_thickness.npz")))
    stages = record["timings_s"]
    for stage, seconds in stages.items():
        print(f"{name:15} {stage:34} {seconds:7.1f} s")
        for step, part in record["steps_s"].get(stage, {}).items():
            print(f"{name:15}     {step:30} {part:7.1f} s")
    print(f"{name:15} {'starting, writing':34} {whole - sum(stages.values()):7.1f} s")
    a_bone = sum(stages[stage] for stage in OF_BONES) / bones
    print(f"{name:15} {'a bone':34} {a_bone:7.1f} s of {BONE_S:.0f} asked")
    work = used.ru_utime + used.ru_stime
    print(f"{name:15} {'the knee':34} {whole:7.1f} s of {KNEE_S:.0f} asked, {work:.1f} s of a core's work")
    print(f"{name:15} {'most memory':34} {used.ru_maxrss / 1e6:7.2f} GB of {MEMORY_GB:.0f} asked", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("names", nargs="*", metavar="NAME", default=["phantom_a"])
    given = parser.parse_args()
    if unknown := set(given.names) - set(CASES):
        parser.error(f"{', '.join(sorted(unknown))}: the names are {', '.join(CASES)}")
    for name in given.names:
        measure(given.shared, name)


if __name__ == "__main__":
    main()
