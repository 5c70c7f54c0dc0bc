"""The command line: arguments in, exit codes out. Nothing else in the package prints.

`app` has the commands; `guard` how they are stopped, `console` what is said, the others the jobs.
"""


def main() -> None:
    """Run `meshreg` with the arguments of this process."""
    from meshreg.cli.app import main as run

    run()
