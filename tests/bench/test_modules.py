"""Every benchmark can be imported with the present code, and its arguments can be parsed."""

import argparse
import inspect

import pytest
from bench.declaration import find_benches

BENCHES = find_benches()
OPTIONAL = ("skimage", "SimpleITK", "opensim")


@pytest.mark.parametrize("name", BENCHES)
def test_a_benchmark_can_be_run(name: str):
    try:
        module = BENCHES[name].module()
    except ModuleNotFoundError as error:
        if str(error.name).partition(".")[0] in OPTIONAL:
            pytest.skip(f"{error.name} is not installed")
        raise
    assert list(inspect.signature(module.run).parameters) == ["run"]
    assert module.__doc__
    if hasattr(module, "arguments"):
        parser = argparse.ArgumentParser()
        module.arguments(parser)
        parser.parse_args([])
