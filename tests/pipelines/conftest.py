"""What the tests of the pipelines share."""

import socket

import pytest


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """No pipeline connects to anything but this computer: the page of outlines is served, and studies have workers."""
    if request.path.name in ("test_outline.py", "test_study.py"):
        return

    def denied(*_: object, **__: object) -> None:
        raise AssertionError("a pipeline used the network")

    monkeypatch.setattr(socket.socket, "connect", denied)
    monkeypatch.setattr(socket.socket, "bind", denied)
    monkeypatch.setattr(socket, "getaddrinfo", denied)
