"""Print the speeds of `marey bench` as one JSON line: ours and the peers', measured in the same run.

    python bench/speeds.py [TRIAL]

Compares the pose solve with scipy.optimize.least_squares, and the level set with scikit-image's where that is installed
(pip install "marey[bench]"). With a trial, the whole way from video to results is timed too.
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path

from marey.io.trial.example import example_folder
from marey.pipelines.progress import RecordingProgress
from marey.pipelines.speed.speeds import machine, measure_speeds
from marey.process import tuned_process

if __name__ == "__main__":
    trial = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    with tuned_process():
        speeds = measure_speeds(trial, example=example_folder(), progress=RecordingProgress())
    print(json.dumps({"machine": machine(), "speeds": [asdict(speed) for speed in speeds]}))
