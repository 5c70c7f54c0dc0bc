"""`python -m meshreg`."""

from meshreg.cli import main

main()
