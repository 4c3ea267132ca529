"""The command line: parses arguments, shows progress, prints results and errors, and returns exit codes."""
