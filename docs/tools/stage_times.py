"""Draw the time of each stage of a capture, for the page on accuracy: `python docs/tools/stage_times.py`.

The times are those of the record that `python -m bench run speed/cores` has written.
"""

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
RECORD = ROOT / "bench" / "records" / "speed" / "cores.json"
PICTURE = ROOT / "docs" / "pictures" / "capture-profile.png"
COLOURS = ("#9fb8d0", "#2f5d8a")
"""Colours of the bars of one core and of all of them."""


def main() -> None:
    """Write the image into docs/pictures."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    whole, stages = record["tables"]
    names = [row["labels"][0] for row in stages["rows"]]
    times = np.array([row["values"][:2] for row in stages["rows"]], float)
    heads = [column["name"].removesuffix(" [s]") for column in stages["columns"][:2]]
    figure = Figure(figsize=(8, 0.32 * len(names) + 1), dpi=120, layout="constrained")
    axes, place = figure.subplots(), np.arange(len(names))
    for k, colour in enumerate(COLOURS):
        bars = axes.barh(
            place + 0.4 * k - 0.2, times[:, k], 0.4, color=colour, label=heads[k].replace("1 cores", "1 core")
        )
        axes.bar_label(bars, [f"{value:.1f}" for value in times[:, k]], padding=3, fontsize=8)
    axes.set_yticks(place, names)
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel(f"time [s]; {whole['title']}, {record['machine']['processor']}")
    axes.legend(frameon=False)
    figure.savefig(PICTURE)


if __name__ == "__main__":
    main()
