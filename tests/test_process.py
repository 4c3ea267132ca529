import os
import threading

import pytest

from marey import process
from marey.process import group_quota, limited_cores, usable_cores


def group(folder, text, **files):
    """A file of the own group, and files of limits below a folder of groups."""
    own, groups = folder / "own", folder / "groups"
    own.write_text(text)
    for name, content in files.items():
        path = groups / name.replace("__", "/").replace("_dot_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return groups, own


def test_the_process_may_use_a_core_at_least_and_all_of_the_machine_at_most():
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


def test_a_limit_holds_in_all_threads_until_its_block_ends():
    before, seen = usable_cores(), []
    with limited_cores(3):
        thread = threading.Thread(target=lambda: seen.append(usable_cores()))
        thread.start()
        thread.join()
        with limited_cores(None):
            assert usable_cores() == 3
        with limited_cores(1):
            assert usable_cores() == 1
        assert usable_cores() == 3
    assert seen == [3]
    assert usable_cores() == before


def test_a_limit_below_one_is_refused():
    with pytest.raises(ValueError, match="at least 1"), limited_cores(0):
        pass


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"cpu_dot_max": "150000 100000\n"}, 1.5),
        ("0::/\n", {"cpu_dot_max": "max 100000\n"}, None),
        ("0::/job/step\n", {"job__cpu_dot_max": "400000 100000", "job__step__cpu_dot_max": "max 100000"}, 4.0),
        ("0::/job/step\n", {"job__cpu_dot_max": "400000 100000", "job__step__cpu_dot_max": "50000 100000"}, 0.5),
        ("4:cpu:/box\n", {"cpu__box__cpu.cfs_quota_us": "200000", "cpu__box__cpu.cfs_period_us": "100000"}, 2.0),
        ("4:cpu:/box\n", {"cpu__box__cpu.cfs_quota_us": "-1", "cpu__box__cpu.cfs_period_us": "100000"}, None),
        ("0::/\n", {"cpu_dot_max": "nonsense"}, None),
        ("0::/\n", {}, None),
    ],
)
def test_the_quota_is_the_smallest_of_the_group_and_those_around_it(tmp_path, own, files, expected):
    assert group_quota(*group(tmp_path, own, **files)) == expected


def test_a_part_of_a_core_counts_as_one(tmp_path, monkeypatch):
    groups, own = group(tmp_path, "0::/\n", cpu_dot_max="20000 100000")
    monkeypatch.setattr(process, "_CONTROL_GROUPS", groups)
    monkeypatch.setattr(process, "_OWN_GROUP", own)
    process._allowed_cores.cache_clear()
    assert usable_cores() == 1
    process._allowed_cores.cache_clear()
