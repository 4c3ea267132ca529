"""Optional packages: what a user reads when one is missing."""

import sys

import pytest

from marey import extras
from marey.errors import MareyError, MissingPackage


def test_an_installed_module_is_imported():
    assert extras.import_optional("json.decoder", extra="knee", purpose="Tests") is sys.modules["json.decoder"]


def test_a_missing_package_is_named_with_a_command_that_does_not_name_marey(monkeypatch):
    declared = [
        'SimpleITK>=2.4; extra == "knee"',
        "scikit-image>=0.24; extra == 'knee'",
        'pytest>=8; extra == "test"',
        "numpy>=2",
    ]
    monkeypatch.setattr(extras, "requires", lambda name: declared)
    with pytest.raises(MissingPackage) as caught:
        extras.import_optional("no_such_package.part", extra="knee", purpose="Surfaces of bones")
    text = str(caught.value)
    assert text.startswith("Surfaces of bones need no_such_package, which is not installed. Run: py")
    assert text.endswith('-m pip install "SimpleITK>=2.4" "scikit-image>=0.24"')
    assert isinstance(caught.value, MareyError)


def test_without_an_installed_package_the_clone_is_named(monkeypatch):
    def missing(name: str) -> list[str]:
        raise extras.PackageNotFoundError(name)

    monkeypatch.setattr(extras, "requires", missing)
    assert extras.install_advice("plot") == 'In a clone of the project, run: python -m pip install ".[plot]"'
