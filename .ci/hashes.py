"""Write the hashes of everything that the checks install: `python .ci/hashes.py FILE`, with the Python of the checks.

The versions are those of constraints.txt, the archives those that pip would install here, and the hashes those that the
index states or pip computes. `make hashes` writes the files of both versions of Python that `.ci/run` uses.
"""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

EXTRAS = "test,knee,plot,xarray,study,docs"
"""The extras that `make test` installs."""


def main() -> None:
    """Ask pip what it would install, and write names, versions and hashes."""
    with open("pyproject.toml", "rb") as file:
        build = tomllib.load(file)["build-system"]["requires"]
    command = [
        sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--report", "-",
        "--constraint", "constraints.txt", f".[{EXTRAS}]", *build,
    ]  # fmt: skip
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    lines = ["# Written by .ci/hashes.py for Linux on x86-64; do not edit. pip installs nothing with another hash."]
    for each in sorted(report["install"], key=lambda each: str(each["metadata"]["name"]).lower()):
        name, version = each["metadata"]["name"], each["metadata"]["version"]
        if name == "marey":
            continue
        kind, _, value = str(each["download_info"]["archive_info"]["hash"]).partition("=")
        lines.append(f"{name}=={version} --hash={kind}:{value}")
    Path(sys.argv[1]).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
