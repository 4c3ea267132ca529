"""Declarations of benchmarks are found without importing them, and name files that exist."""

from pathlib import Path

import pytest
from bench.declaration import GROUPS, find_benches

PROJECT = Path(__file__).parents[2]
BENCHES = find_benches()


def test_every_group_has_benches():
    assert {bench.group for bench in BENCHES.values()} == set(GROUPS)


@pytest.mark.parametrize("name", BENCHES)
def test_declared_sources_exist(name: str):
    bench = BENCHES[name]
    missing = [source for source in (*bench.sources, bench.file) if not (PROJECT / source).exists()]
    assert not missing


@pytest.mark.parametrize("name", BENCHES)
def test_each_declaration_is_complete(name: str):
    bench = BENCHES[name]
    assert bench.measures.endswith(".")
    assert bench.sources
    assert bench.minutes > 0


def test_a_module_without_a_declaration_is_no_bench(tmp_path: Path):
    group = tmp_path / "capture"
    group.mkdir()
    (group / "helper.py").write_text("VALUE = 1\n")
    (group / "made.py").write_text(
        'raise RuntimeError\nBENCH = Bench(measures="A length.", sources=("src",), minutes=1)\n'
    )
    found = find_benches(tmp_path)
    assert list(found) == ["capture/made"]
    assert found["capture/made"].measures == "A length."
    assert found["capture/made"].group == "capture"
