"""Speed measurements, each compared with another program or with a limit."""
