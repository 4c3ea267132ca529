"""What the tests of the pipelines share."""

import socket

import pytest


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """No pipeline connects to anything; only the page of outlines is served, to this computer."""
    if request.path.name == "test_outline.py":
        return

    def denied(*_: object, **__: object) -> None:
        raise AssertionError("a pipeline used the network")

    monkeypatch.setattr(socket.socket, "connect", denied)
    monkeypatch.setattr(socket.socket, "bind", denied)
    monkeypatch.setattr(socket, "getaddrinfo", denied)
