"""`python -m meshreg`."""

from meshreg.cli.app import main

main()
