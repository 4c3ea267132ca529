"""Print the speeds of `marey bench` as one JSON line: ours and the peers', measured in the same run.

    python bench/speeds.py [TRIAL]

Compares the pose solve with scipy.optimize.least_squares, and the level set with scikit-image's where that is installed
(pip install "marey[bench]"). With a trial, the whole way from video to results is timed too.
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path

from marey.cli.main import example_folder
from marey.pipelines.speed.speeds import bench, machine

if __name__ == "__main__":
    trial = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    speeds = bench(trial, example=example_folder())
    print(json.dumps({"machine": machine(), "speeds": [asdict(speed) for speed in speeds]}))
