"""The program `marey` as `python -m marey`."""

from marey.cli.main import main

main()
