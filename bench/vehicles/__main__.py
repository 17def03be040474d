"""See `command.py`; this file only lets `python bench/vehicles` start it."""

from command import main

main()
