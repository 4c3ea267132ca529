"""The catalogue of bad inputs covers every command and every option."""

import shlex
from collections import Counter

from bench.inputs.catalogue import ENTRIES, command_of
from bench.inputs.entries.options import commands

FEWEST = 250
"""Number of entries that the catalogue should have at least."""


def test_every_command_and_option_is_typed():
    typed: dict[str, set[str]] = {name: set() for name in commands()}
    for entry in ENTRIES:
        if command_of(entry.typed) in typed:
            typed[command_of(entry.typed)] |= {word.partition("=")[0] for word in shlex.split(entry.typed)}
    for name, command in commands().items():
        options = {option.opts[0] for option in command.params if option.param_type_name == "option"}
        flags = {option.opts[0] for option in command.params if getattr(option, "is_flag", False)}
        assert options - flags <= typed[name], name
    assert len(ENTRIES) >= FEWEST


def test_no_entry_is_there_twice():
    counts = Counter((entry.typed, entry.why, entry.how) for entry in ENTRIES)
    assert {entry: count for entry, count in counts.items() if count > 1} == {}


def test_every_entry_states_what_the_message_must_contain():
    assert all(entry.shown and all(entry.shown) for entry in ENTRIES)
